/* Stand-in of libaravis-0.8: one GenICam camera. It watches references, buffers and order, and whether errors
 * are looked at and freed.
 *
 * Properties (set KEY VALUE): serial, width, height (of the sensor), step (increment of size and offsets),
 * first (identifier of the first frame), rate_switch (name of the feature that switches the frame rate on).
 * At a pop, 'error N' delivers a buffer of that status, 'lose N' skips frames, 'timeout MS' delivers none.
 */
#define _GNU_SOURCE
#include "stand_in.h"

#include <stdatomic.h>

typedef struct {
    uint32_t domain;
    int code;
    char *message;
} GError;
typedef struct {
    int owned_by_stream, status;
    uint64_t id, stamp_ns;
    int width, height;
    size_t size;
    unsigned char *data;
} Buffer;

#define BUFFERS 64
#define MAX_SIDE 4096

static struct {
    atomic_int alive, acquiring, waiting;
    struct si_link bench;
    int linked;
    int x, y, width, height, bytes, rate_on;
    double exposure_us, rate_hz, gain_db;
} camera;
static struct {
    atomic_int alive;
    Buffer *queue[BUFFERS];
    int n;
    int64_t start_ns;
    long next;
} stream;
static char serial[64], rate_switch[64];
static int sensor_w, sensor_h, step, errors_alive;
static long first;
static struct {
    int64_t index, exposed_ns;
    uint16_t pixels[MAX_SIDE * MAX_SIDE];
} from_bench;

static void si_forget(void) {
    if (camera.linked) si_unlink_bench(&camera.bench);
    memset(&camera, 0, sizeof camera);
    memset(&stream, 0, sizeof stream);
    camera.bench.fd = -1;
    snprintf(serial, sizeof serial, "SIMSCI");
    snprintf(rate_switch, sizeof rate_switch, "AcquisitionFrameRateEnable");
    sensor_w = 720;
    sensor_h = 540;
    step = 2;
    first = 65401; /* so that a run of a few seconds crosses the end of the 16-bit counter */
    errors_alive = 0;
}

static int si_set(const char *key, const char *value) {
    int whole = atoi(value);
    if (strcmp(key, "serial") == 0) return snprintf(serial, sizeof serial, "%s", value) > 0;
    if (strcmp(key, "rate_switch") == 0) return snprintf(rate_switch, sizeof rate_switch, "%s", value) > 0;
    if (strcmp(key, "width") == 0) return (sensor_w = whole) > 0 && whole <= MAX_SIDE;
    if (strcmp(key, "height") == 0) return (sensor_h = whole) > 0 && whole <= MAX_SIDE;
    if (strcmp(key, "step") == 0) return (step = whole) > 0;
    if (strcmp(key, "first") == 0) return (first = whole) >= 0;
    return 0;
}

EXPORT const char *escape_stand_in(void) { return "libaravis stand-in"; }

/* Objects and errors that were handed out and not given back. */
EXPORT int escape_stand_in_leaks(void) { return camera.alive + stream.alive + errors_alive; }

static void fails(GError **error, const char *message) {
    if (error == NULL) return;
    if (*error) si_complain("a place for an error holds an old one");
    GError *made = malloc(sizeof *made);
    made->domain = 1;
    made->code = 1;
    made->message = strdup(message);
    errors_alive++;
    *error = made;
}

EXPORT void g_error_free(GError *error) {
    errors_alive--;
    free(error->message);
    free(error);
}

static int refused(void *handle, struct si_function *function, struct si_rule *rule, GError **error) {
    *rule = si_enter(function);
    if (handle != &camera || !camera.alive) {
        si_complain("%s: not a camera", function->name);
        return fails(error, "not a camera"), 1;
    }
    if (si_unplugged) return fails(error, "USB3Vision read_memory error: LIBUSB_ERROR_NO_DEVICE"), 1;
    if (rule->action == SI_ERROR) return fails(error, "as the script says"), 1;
    return rule->action == SI_IGNORE;
}

/* On refusal return `otherwise`, which is left out where nothing is returned. */
#define BEGIN(title, otherwise, ...)                                                                          \
    static struct si_function f = {.name = title};                                                            \
    struct si_rule rule;                                                                                      \
    si_log(title __VA_ARGS__);                                                                                \
    if (refused(handle, &f, &rule, error)) return otherwise

/* ---- devices ------------------------------------------------------------------------------------------ */
EXPORT void arv_enable_interface(const char *name) { si_log("arv_enable_interface %s", name); }
EXPORT void arv_update_device_list(void) { si_log("arv_update_device_list"); }
EXPORT unsigned arv_get_n_devices(void) { return !si_unplugged; }
EXPORT const char *arv_get_device_id(unsigned k) { return k ? NULL : "FLIR-Stand-in"; }
EXPORT const char *arv_get_device_serial_nbr(unsigned k) { return k ? NULL : serial; }

EXPORT void *arv_camera_new(const char *name, GError **error) {
    static struct si_function f = {.name = "arv_camera_new"};
    struct si_rule rule = si_enter(&f);
    si_log("arv_camera_new %s", name ? name : "NULL");
    if (rule.action == SI_ERROR || si_unplugged) return fails(error, "cannot be opened"), NULL;
    if (camera.alive) {
        si_complain("arv_camera_new: the camera has an owner already");
        return fails(error, "busy: used by another process"), NULL;
    }
    uint32_t greeting[1];
    int linked = si_link_bench(&camera.bench, "science", serial, greeting, sizeof greeting);
    if (linked < 0) return fails(error, "the simulated bench has no such camera"), NULL;
    camera.linked = linked;
    camera.x = camera.y = 0;
    camera.width = sensor_w;
    camera.height = sensor_h;
    camera.bytes = 1;
    camera.exposure_us = 10000;
    camera.rate_hz = 30;
    camera.gain_db = camera.rate_on = camera.acquiring = camera.waiting = 0;
    camera.alive = 1;
    return &camera;
}

EXPORT void g_object_unref(void *object) {
    if (object == &stream && stream.alive) {
        si_log("g_object_unref stream");
        if (camera.acquiring) si_complain("g_object_unref: the stream goes while the camera acquires");
        if (camera.waiting) si_complain("g_object_unref: the stream goes while somebody waits at it");
        for (int k = 0; k < stream.n; k++) {
            free(stream.queue[k]->data);
            free(stream.queue[k]);
        }
        stream.n = 0;
        stream.alive = 0;
    } else if (object == &camera && camera.alive) {
        si_log("g_object_unref camera");
        if (stream.alive) si_complain("g_object_unref: the camera goes before its stream");
        camera.alive = 0;
        si_unlink_bench(&camera.bench);
    } else {
        si_complain("g_object_unref: no such object, or given back twice");
    }
}

/* ---- features ----------------------------------------------------------------------------------------- */
static double fastest_hz(void) { return 1e6 / fmax(200 + 10.0 * camera.height, camera.exposure_us + 50); }

EXPORT const char *arv_camera_get_model_name(void *handle, GError **error) {
    BEGIN("arv_camera_get_model_name", NULL, "%s", "");
    return "Grasshopper3";
}

#define WHOLES(name, one, other)                                                                              \
    EXPORT void arv_camera_get_##name(void *handle, int *low, int *high, GError **error) {                    \
        BEGIN("arv_camera_get_" #name, , "%s", "");                                                           \
        *low = one;                                                                                           \
        *high = other;                                                                                        \
    }
WHOLES(sensor_size, sensor_w, sensor_h)
WHOLES(width_bounds, step, sensor_w - camera.x)
WHOLES(height_bounds, step, sensor_h - camera.y)

#define INCREMENT(name)                                                                                       \
    EXPORT int arv_camera_get_##name##_increment(void *handle, GError **error) {                              \
        BEGIN("arv_camera_get_" #name "_increment", 0, "%s", "");                                             \
        return step;                                                                                          \
    }
INCREMENT(width)
INCREMENT(height)
INCREMENT(x_offset)
INCREMENT(y_offset)

#define REAL(name, field, lowest, highest)                                                                    \
    EXPORT void arv_camera_get_##name##_bounds(void *handle, double *low, double *high, GError **error) {     \
        BEGIN("arv_camera_get_" #name "_bounds", , "%s", "");                                                 \
        *low = lowest;                                                                                        \
        *high = highest;                                                                                      \
    }                                                                                                         \
    EXPORT double arv_camera_get_##name(void *handle, GError **error) {                                       \
        BEGIN("arv_camera_get_" #name, 0, "%s", "");                                                          \
        return camera.field;                                                                                  \
    }                                                                                                         \
    EXPORT void arv_camera_set_##name(void *handle, double value, GError **error) {                           \
        BEGIN("arv_camera_set_" #name, , " %.9g", value);                                                     \
        if (!(value >= (lowest) * (1 - 1e-9) && value <= (highest) * (1 + 1e-9))) {                           \
            si_complain(#name " = %g lies outside %g..%g", value, (double)(lowest), (double)(highest));       \
            fails(error, #name " out of range");                                                              \
            return;                                                                                           \
        }                                                                                                     \
        camera.field = value;                                                                                 \
        camera.rate_hz = fmin(camera.rate_hz, fastest_hz());                                                  \
    }
REAL(exposure_time, exposure_us, 10.0, 1e7)
REAL(gain, gain_db, 0.0, 48.0)
REAL(frame_rate, rate_hz, 0.1, fastest_hz())

EXPORT void arv_camera_set_region(void *handle, int x, int y, int width, int height, GError **error) {
    BEGIN("arv_camera_set_region", , " %d %d %d %d", x, y, width, height);
    if (camera.acquiring) {
        si_complain("the region cannot be set while the camera acquires");
        return fails(error, "region locked");
    }
    if (x < 0 || y < 0 || width < step || height < step || x + width > sensor_w || y + height > sensor_h ||
        x % step || y % step || width % step || height % step) {
        si_complain("region %d %d %d %d does not fit the sensor", x, y, width, height);
        return fails(error, "region out of range");
    }
    camera.x = x;
    camera.y = y;
    camera.width = width;
    camera.height = height;
    camera.rate_hz = fmin(camera.rate_hz, fastest_hz());
}

EXPORT void arv_camera_get_region(void *handle, int *x, int *y, int *width, int *height, GError **error) {
    BEGIN("arv_camera_get_region", , "%s", "");
    *x = camera.x;
    *y = camera.y;
    *width = camera.width;
    *height = camera.height;
}

EXPORT void arv_camera_set_pixel_format_from_string(void *handle, const char *format, GError **error) {
    BEGIN("arv_camera_set_pixel_format_from_string", , " %s", format);
    if (strcmp(format, "Mono16") && strcmp(format, "Mono12") && strcmp(format, "Mono8"))
        return fails(error, "[PixelFormat] entry not found");
    camera.bytes = strcmp(format, "Mono8") ? 2 : 1;
}

EXPORT int arv_camera_is_feature_available(void *handle, const char *name, GError **error) {
    BEGIN("arv_camera_is_feature_available", 0, " %s", name);
    return !strcmp(name, rate_switch) || !strcmp(name, "ExposureAuto") || !strcmp(name, "GainAuto");
}

EXPORT void arv_camera_set_boolean(void *handle, const char *name, int value, GError **error) {
    BEGIN("arv_camera_set_boolean", , " %s %d", name, value);
    if (strcmp(name, rate_switch)) return fails(error, "node not found");
    camera.rate_on = value;
}

EXPORT void arv_camera_set_string(void *handle, const char *name, const char *value, GError **error) {
    BEGIN("arv_camera_set_string", , " %s %s", name, value);
    if (strcmp(name, "ExposureAuto") && strcmp(name, "GainAuto")) fails(error, "node not found");
}

EXPORT unsigned arv_camera_get_payload(void *handle, GError **error) {
    BEGIN("arv_camera_get_payload", 0, "%s", "");
    return (unsigned)(camera.width * camera.height * camera.bytes);
}

/* ---- stream ------------------------------------------------------------------------------------------- */
EXPORT void *arv_camera_create_stream(void *handle, void *callback, void *user, GError **error) {
    BEGIN("arv_camera_create_stream", NULL, "%s", "");
    if (callback || user) si_complain("arv_camera_create_stream: a callback into an interpreter");
    if (stream.alive) return fails(error, "stream exists"), NULL;
    stream.n = 0;
    stream.alive = 1;
    return &stream;
}

EXPORT void *arv_buffer_new_allocate(size_t size) {
    Buffer *buffer = calloc(1, sizeof *buffer);
    buffer->size = size;
    buffer->data = malloc(size);
    return buffer;
}

EXPORT void arv_stream_push_buffer(void *handle, Buffer *buffer) {
    if (handle != &stream || !stream.alive || buffer->owned_by_stream || stream.n == BUFFERS) {
        si_complain("arv_stream_push_buffer: no stream, a buffer pushed twice, or too many");
        return;
    }
    buffer->owned_by_stream = 1;
    stream.queue[stream.n++] = buffer;
}

EXPORT void arv_camera_start_acquisition(void *handle, GError **error) {
    BEGIN("arv_camera_start_acquisition", , "%s", "");
    if (!stream.alive || stream.n == 0) {
        si_complain("arv_camera_start_acquisition: no stream, or no buffer in it");
        return fails(error, "no stream");
    }
    if (!camera.rate_on) si_complain("the frame rate was never switched on");
    if (camera.linked) {
        struct {
            uint32_t region[4];
            double exposure_us, rate_hz, gain_db;
        } wanted = {{(uint32_t)camera.x, (uint32_t)camera.y, (uint32_t)camera.width, (uint32_t)camera.height},
                    camera.exposure_us, camera.rate_hz, camera.gain_db};
        if (si_ask(&camera.bench, SI_START, &wanted, sizeof wanted, NULL, 0, NULL) != 0)
            return fails(error, "the simulated bench refuses");
    }
    stream.start_ns = si_now_ns();
    stream.next = 0;
    camera.acquiring = 1;
}

EXPORT void arv_camera_stop_acquisition(void *handle, GError **error) {
    camera.acquiring = 0; /* asked for, even if it fails now */
    BEGIN("arv_camera_stop_acquisition", , "%s", "");
    if (camera.waiting) si_complain("arv_camera_stop_acquisition: somebody waits at the stream");
    if (camera.linked) si_ask(&camera.bench, SI_STOP, NULL, 0, NULL, 0, NULL);
}

/* Fill a buffer with frame k: 1 filled, 0 none in time. */
static int fill(Buffer *buffer, uint64_t wait_us, const struct si_rule *rule) {
    int n = camera.width * camera.height;
    long k;
    if (camera.linked) {
        double wait_s = (double)wait_us * 1e-6;
        uint32_t got = 0;
        if (si_ask(&camera.bench, SI_FRAME, &wait_s, sizeof wait_s, &from_bench, sizeof from_bench, &got) != 0 ||
            got != 16 + 2u * (uint32_t)n)
            return 0;
        k = (long)from_bench.index;
        buffer->stamp_ns = (uint64_t)from_bench.exposed_ns;
    } else {
        k = stream.next + (rule->action == SI_LOSE ? rule->argument : 0);
        int64_t ready = stream.start_ns + (int64_t)((double)(k + 1) * 1e9 / camera.rate_hz);
        int64_t deadline = si_now_ns() + (int64_t)wait_us * 1000;
        si_sleep_until(ready < deadline ? ready : deadline);
        if (ready > deadline || si_unplugged) return 0;
        buffer->stamp_ns = (uint64_t)ready;
    }
    if (buffer->size < (size_t)(n * camera.bytes)) {
        si_complain("a buffer of %zu bytes cannot hold %d pixels", buffer->size, n);
        return 0;
    }
    for (int i = 0; i < n; i++) {
        int value = camera.linked ? from_bench.pixels[i]
                                  : (3 * (i % camera.width) + 7 * (i / camera.width)) & 4095;
        if (camera.bytes == 2) ((uint16_t *)buffer->data)[i] = (uint16_t)value;
        else buffer->data[i] = (unsigned char)value;
    }
    stream.next = k + 1;
    long turn = first + k;
    buffer->id = (uint64_t)(turn <= 65535 ? turn : (turn - 1) % 65535 + 1);
    buffer->width = camera.width;
    buffer->height = camera.height;
    return 1;
}

static void *pop(const char *name, struct si_function *function, void *handle, uint64_t wait_us) {
    struct si_rule rule = si_enter(function);
    if (handle != &stream || !stream.alive || !camera.acquiring) {
        si_complain("%s: no stream, or the camera does not acquire", name);
        return NULL;
    }
    if (stream.n == 0) {
        si_complain("%s: no buffer is left; push them back", name);
        return NULL;
    }
    camera.waiting++;
    Buffer *buffer = stream.queue[0];
    int filled = 0;
    if (rule.action == SI_TIMEOUT || si_unplugged) si_sleep_until(si_now_ns() + (int64_t)wait_us * 1000);
    else filled = fill(buffer, wait_us, &rule);
    camera.waiting--;
    if (!filled) return NULL;
    buffer->status = rule.action == SI_ERROR ? (int)rule.argument : 0;
    buffer->owned_by_stream = 0;
    memmove(stream.queue, stream.queue + 1, sizeof *stream.queue * (size_t)--stream.n);
    return buffer;
}

EXPORT void *arv_stream_try_pop_buffer(void *handle) {
    static struct si_function f = {.name = "arv_stream_try_pop_buffer"};
    return pop("arv_stream_try_pop_buffer", &f, handle, 0);
}

EXPORT void *arv_stream_timeout_pop_buffer(void *handle, uint64_t wait_us) {
    static struct si_function f = {.name = "arv_stream_timeout_pop_buffer"};
    si_log("arv_stream_timeout_pop_buffer %lu", (unsigned long)wait_us);
    return pop("arv_stream_timeout_pop_buffer", &f, handle, wait_us);
}

EXPORT const void *arv_buffer_get_data(Buffer *buffer, size_t *size) {
    if (size) *size = buffer->size;
    return buffer->data;
}
EXPORT int arv_buffer_get_status(Buffer *buffer) { return buffer->status; }
EXPORT uint64_t arv_buffer_get_frame_id(Buffer *buffer) { return buffer->id; }
EXPORT uint64_t arv_buffer_get_timestamp(Buffer *buffer) { return buffer->stamp_ns; }
EXPORT int arv_buffer_get_image_width(Buffer *buffer) { return buffer->width; }
EXPORT int arv_buffer_get_image_height(Buffer *buffer) { return buffer->height; }
