/* Stand-in of libaravis-0.8: one GenICam camera, strict about references, buffers, order, and errors that are
 * not freed.
 *
 * Properties (set KEY VALUE): profile (below; sets the next four), serial, width, height (of the sensor),
 * increment (of size and offsets), first_frame (its identifier), rate_switch (name of the feature that enables
 * the frame rate). ESCAPE_ARAVIS_PROFILE names the profile of a process.
 * For a pop, 'error N' delivers a buffer of that status, 'drop N' skips frames, 'timeout MS' delivers none.
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
    struct si_connection bench;
    int linked;
    int x, y, width, height, bits, bytes, rate_enabled;
    double exposure_us, rate_hz, gain_db;
} camera;
static struct {
    atomic_int alive;
    Buffer *queue[BUFFERS];
    int n;
    int64_t start_ns;
    long next;
} stream;
/* Cameras: a Grasshopper3 of FLIR, and a C-Blue One of First Light, which has no automatic exposure or gain,
 * starts an exposure 5 us after the last, and reads 1104 rows in 1.5 ms. */
static const struct profile {
    const char *name, *model, *serial, *formats;
    int width, height, has_auto;
    double dead_us, fixed_us, row_us;
} profiles[] = {
    {"grasshopper3", "Grasshopper3", "SIMSCI", "Mono16 Mono12 Mono8", 720, 540, 1, 50, 200, 10},
    {"c-blue-one", "C-BLUE One", "SIMCBLUE", "Mono12 Mono10 Mono8", 1604, 1104, 0, 5, 20, 1.36},
};
static const struct profile *profile;
static char serial[64], rate_switch[64];
static int sensor_w, sensor_h, increment, n_open_errors, n_open_lists;
static long first_frame;
static struct {
    int64_t index, exposed_ns;
    uint16_t pixels[MAX_SIDE * MAX_SIDE];
} from_bench;

static int set_profile(const char *name) {
    for (unsigned k = 0; k < sizeof profiles / sizeof *profiles; k++)
        if (strcmp(profiles[k].name, name) == 0) {
            profile = &profiles[k];
            snprintf(serial, sizeof serial, "%s", profile->serial);
            sensor_w = profile->width;
            sensor_h = profile->height;
            return 1;
        }
    return 0;
}

static void si_reset_device(void) {
    if (camera.linked) si_disconnect_bench(&camera.bench);
    memset(&camera, 0, sizeof camera);
    memset(&stream, 0, sizeof stream);
    camera.bench.fd = -1;
    const char *wanted = getenv("ESCAPE_ARAVIS_PROFILE");
    if (wanted == NULL || !set_profile(wanted)) set_profile(profiles[0].name);
    snprintf(rate_switch, sizeof rate_switch, "AcquisitionFrameRateEnable");
    increment = 2;
    first_frame = 65401; /* a run of a few seconds crosses the end of the 16-bit counter */
    n_open_errors = n_open_lists = 0;
}

static int si_set_property(const char *key, const char *value) {
    int integer = atoi(value);
    if (strcmp(key, "profile") == 0) return set_profile(value);
    if (strcmp(key, "serial") == 0) return snprintf(serial, sizeof serial, "%s", value) > 0;
    if (strcmp(key, "rate_switch") == 0) return snprintf(rate_switch, sizeof rate_switch, "%s", value) > 0;
    if (strcmp(key, "width") == 0) return (sensor_w = integer) > 0 && integer <= MAX_SIDE;
    if (strcmp(key, "height") == 0) return (sensor_h = integer) > 0 && integer <= MAX_SIDE;
    if (strcmp(key, "increment") == 0) return (increment = integer) > 0;
    if (strcmp(key, "first_frame") == 0) return (first_frame = integer) >= 0;
    return 0;
}

EXPORT const char *escape_stand_in(void) { return "libaravis stand-in"; }

/* Objects, errors and lists that were not released. */
EXPORT int escape_stand_in_leaks(void) { return camera.alive + stream.alive + n_open_errors + n_open_lists; }

static void set_error(GError **error, const char *message) {
    if (error == NULL) return;
    if (*error) si_report_violation("an error pointer is not NULL");
    GError *made = malloc(sizeof *made);
    made->domain = 1;
    made->code = 1;
    made->message = strdup(message);
    n_open_errors++;
    *error = made;
}

EXPORT void g_error_free(GError *error) {
    n_open_errors--;
    free(error->message);
    free(error);
}

static int call_rejected(void *handle, struct si_function *function, struct si_rule *rule, GError **error) {
    *rule = si_begin_call(function);
    if (handle != &camera || !camera.alive) {
        si_report_violation("%s: not a camera", function->name);
        return set_error(error, "not a camera"), 1;
    }
    if (si_unplugged) return set_error(error, "USB3Vision read_memory error: LIBUSB_ERROR_NO_DEVICE"), 1;
    if (rule->action == SI_ERROR) return set_error(error, "scripted error"), 1;
    return rule->action == SI_IGNORE;
}

/* When rejected return `otherwise`, which is empty for functions without result. */
#define BEGIN(title, otherwise, ...)                                                                          \
    static struct si_function f = {.name = title};                                                            \
    struct si_rule rule;                                                                                      \
    si_log(title __VA_ARGS__);                                                                                \
    if (call_rejected(handle, &f, &rule, error)) return otherwise

/* ---- devices ------------------------------------------------------------------------------------------ */
EXPORT void arv_enable_interface(const char *name) { si_log("arv_enable_interface %s", name); }
EXPORT void arv_update_device_list(void) { si_log("arv_update_device_list"); }
EXPORT unsigned arv_get_n_devices(void) { return !si_unplugged; }
EXPORT const char *arv_get_device_id(unsigned k) { return k ? NULL : "FLIR-Stand-in"; }
EXPORT const char *arv_get_device_serial_nbr(unsigned k) { return k ? NULL : serial; }

EXPORT void *arv_camera_new(const char *name, GError **error) {
    static struct si_function f = {.name = "arv_camera_new"};
    struct si_rule rule = si_begin_call(&f);
    si_log("arv_camera_new %s", name ? name : "NULL");
    if (rule.action == SI_ERROR || si_unplugged) return set_error(error, "cannot be opened"), NULL;
    if (camera.alive) {
        si_report_violation("arv_camera_new: the camera has an owner already");
        return set_error(error, "busy: used by another process"), NULL;
    }
    uint32_t greeting[1];
    int linked = si_connect_bench(&camera.bench, "camera", serial, greeting, sizeof greeting);
    if (linked < 0) return set_error(error, "the simulated bench has no such camera"), NULL;
    camera.linked = linked;
    camera.x = camera.y = 0;
    camera.width = sensor_w;
    camera.height = sensor_h;
    camera.bytes = 1;
    camera.bits = 8;
    camera.exposure_us = 10000;
    camera.rate_hz = 30;
    camera.gain_db = camera.rate_enabled = camera.acquiring = camera.waiting = 0;
    camera.alive = 1;
    return &camera;
}

EXPORT void g_object_unref(void *object) {
    if (object == &stream && stream.alive) {
        si_log("g_object_unref stream");
        if (camera.acquiring)
            si_report_violation("g_object_unref: the stream is released while the camera acquires");
        if (camera.waiting)
            si_report_violation("g_object_unref: the stream is released while a call waits for it");
        for (int k = 0; k < stream.n; k++) {
            free(stream.queue[k]->data);
            free(stream.queue[k]);
        }
        stream.n = 0;
        stream.alive = 0;
    } else if (object == &camera && camera.alive) {
        si_log("g_object_unref camera");
        if (stream.alive) si_report_violation("g_object_unref: the camera is released before its stream");
        camera.alive = 0;
        si_disconnect_bench(&camera.bench);
    } else {
        si_report_violation("g_object_unref: no such object, or released twice");
    }
}

/* ---- features ----------------------------------------------------------------------------------------- */
static double fastest_hz(void) {
    return 1e6 / fmax(profile->fixed_us + profile->row_us * camera.height, camera.exposure_us + profile->dead_us);
}

EXPORT const char *arv_camera_get_model_name(void *handle, GError **error) {
    BEGIN("arv_camera_get_model_name", NULL, "%s", "");
    return profile->model;
}

#define INT_PAIR_GETTER(name, one, other)                                                                     \
    EXPORT void arv_camera_get_##name(void *handle, int *low, int *high, GError **error) {                    \
        BEGIN("arv_camera_get_" #name, , "%s", "");                                                           \
        *low = one;                                                                                           \
        *high = other;                                                                                        \
    }
INT_PAIR_GETTER(sensor_size, sensor_w, sensor_h)
INT_PAIR_GETTER(width_bounds, increment, sensor_w - camera.x)
INT_PAIR_GETTER(height_bounds, increment, sensor_h - camera.y)

#define INCREMENT(name)                                                                                       \
    EXPORT int arv_camera_get_##name##_increment(void *handle, GError **error) {                              \
        BEGIN("arv_camera_get_" #name "_increment", 0, "%s", "");                                             \
        return increment;                                                                                     \
    }
INCREMENT(width)
INCREMENT(height)
INCREMENT(x_offset)
INCREMENT(y_offset)

#define FLOAT_FEATURE(name, field, lowest, highest)                                                           \
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
            si_report_violation(#name " = %g lies outside %g..%g", value, lowest + 0.0, highest + 0.0);       \
            set_error(error, #name " out of range");                                                          \
            return;                                                                                           \
        }                                                                                                     \
        camera.field = value;                                                                                 \
        camera.rate_hz = fmin(camera.rate_hz, fastest_hz());                                                  \
    }
FLOAT_FEATURE(exposure_time, exposure_us, 10.0, 1e7)
FLOAT_FEATURE(gain, gain_db, 0.0, 48.0)
FLOAT_FEATURE(frame_rate, rate_hz, 0.1, fastest_hz())

EXPORT void arv_camera_set_region(void *handle, int x, int y, int width, int height, GError **error) {
    BEGIN("arv_camera_set_region", , " %d %d %d %d", x, y, width, height);
    if (camera.acquiring) {
        si_report_violation("the region cannot be set while the camera acquires");
        return set_error(error, "region locked");
    }
    int inside = x >= 0 && y >= 0 && x + width <= sensor_w && y + height <= sensor_h;
    int aligned = !(x % increment || y % increment || width % increment || height % increment);
    if (!inside || !aligned || width < increment || height < increment) {
        si_report_violation("region %d %d %d %d does not fit the sensor", x, y, width, height);
        return set_error(error, "region out of range");
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
    if (strncmp(format, "Mono", 4) || strstr(profile->formats, format) == NULL)
        return set_error(error, "[PixelFormat] entry not found");
    camera.bits = atoi(format + 4);
    camera.bytes = camera.bits > 8 ? 2 : 1;
}

/* The caller frees the list, not the names in it. */
EXPORT const char **arv_camera_dup_available_pixel_formats_as_strings(void *handle, unsigned *n, GError **error) {
    static char names[64];
    BEGIN("arv_camera_dup_available_pixel_formats_as_strings", NULL, "%s", "");
    snprintf(names, sizeof names, "%s", profile->formats);
    const char **list = malloc(sizeof names * sizeof *list);
    *n = 0;
    for (char *name = strtok(names, " "); name; name = strtok(NULL, " ")) list[(*n)++] = name;
    n_open_lists++;
    return list;
}

EXPORT void g_free(void *list) {
    if (list == NULL) return;
    n_open_lists--;
    free(list);
}

EXPORT int arv_camera_is_feature_available(void *handle, const char *name, GError **error) {
    BEGIN("arv_camera_is_feature_available", 0, " %s", name);
    int is_auto = !strcmp(name, "ExposureAuto") || !strcmp(name, "GainAuto");
    return !strcmp(name, rate_switch) || (is_auto && profile->has_auto);
}

EXPORT void arv_camera_set_boolean(void *handle, const char *name, int value, GError **error) {
    BEGIN("arv_camera_set_boolean", , " %s %d", name, value);
    if (strcmp(name, rate_switch)) return set_error(error, "node not found");
    camera.rate_enabled = value;
}

EXPORT void arv_camera_set_string(void *handle, const char *name, const char *value, GError **error) {
    BEGIN("arv_camera_set_string", , " %s %s", name, value);
    if (!profile->has_auto || (strcmp(name, "ExposureAuto") && strcmp(name, "GainAuto"))) set_error(error, "node not found");
}

EXPORT unsigned arv_camera_get_payload(void *handle, GError **error) {
    BEGIN("arv_camera_get_payload", 0, "%s", "");
    return (unsigned)(camera.width * camera.height * camera.bytes);
}

/* ---- stream ------------------------------------------------------------------------------------------- */
EXPORT void *arv_camera_create_stream(void *handle, void *callback, void *user, GError **error) {
    BEGIN("arv_camera_create_stream", NULL, "%s", "");
    if (callback || user) si_report_violation("arv_camera_create_stream: a callback into an interpreter");
    if (stream.alive) return set_error(error, "stream exists"), NULL;
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
        si_report_violation("arv_stream_push_buffer: no stream, a buffer pushed twice, or too many");
        return;
    }
    buffer->owned_by_stream = 1;
    stream.queue[stream.n++] = buffer;
}

EXPORT void arv_camera_start_acquisition(void *handle, GError **error) {
    BEGIN("arv_camera_start_acquisition", , "%s", "");
    if (!stream.alive || stream.n == 0) {
        si_report_violation("arv_camera_start_acquisition: no stream, or no buffer in it");
        return set_error(error, "no stream");
    }
    if (!camera.rate_enabled) si_report_violation("the frame rate is not enabled");
    if (camera.linked) {
        struct {
            uint32_t region[4];
            double exposure_us, rate_hz, gain_db;
        } wanted = {{(uint32_t)camera.x, (uint32_t)camera.y, (uint32_t)camera.width, (uint32_t)camera.height},
                    camera.exposure_us, camera.rate_hz, camera.gain_db};
        if (si_request(&camera.bench, SI_START, &wanted, sizeof wanted, NULL, 0, NULL) != 0)
            return set_error(error, "the simulated bench refused the settings");
    }
    stream.start_ns = si_now_ns();
    stream.next = 0;
    camera.acquiring = 1;
}

EXPORT void arv_camera_stop_acquisition(void *handle, GError **error) {
    camera.acquiring = 0; /* requested, even if it fails now */
    BEGIN("arv_camera_stop_acquisition", , "%s", "");
    if (camera.waiting) si_report_violation("arv_camera_stop_acquisition: a call waits for the stream");
    if (camera.linked) si_request(&camera.bench, SI_STOP, NULL, 0, NULL, 0, NULL);
}

/* Fill a buffer with the next frame: 1 filled, 0 no frame in time. */
static int fill_buffer(Buffer *buffer, uint64_t wait_us, const struct si_rule *rule) {
    int n = camera.width * camera.height;
    long k;
    if (camera.linked) {
        double wait_s = (double)wait_us * 1e-6;
        uint32_t got = 0;
        int status = si_request(&camera.bench, SI_FRAME, &wait_s, sizeof wait_s, &from_bench,
                                sizeof from_bench, &got);
        if (status != 0 || got != 16 + 2u * (uint32_t)n) return 0;
        k = (long)from_bench.index;
        buffer->stamp_ns = (uint64_t)from_bench.exposed_ns;
    } else {
        k = stream.next + (rule->action == SI_DROP ? rule->argument : 0);
        int64_t ready = stream.start_ns + (int64_t)((double)(k + 1) * 1e9 / camera.rate_hz);
        int64_t deadline = si_now_ns() + (int64_t)wait_us * 1000;
        si_sleep_until(ready < deadline ? ready : deadline);
        if (ready > deadline || si_unplugged) return 0;
        buffer->stamp_ns = (uint64_t)ready;
    }
    if (buffer->size < (size_t)(n * camera.bytes)) {
        si_report_violation("a buffer of %zu bytes cannot hold %d pixels", buffer->size, n);
        return 0;
    }
    int full_scale = camera.bits < 12 ? (1 << camera.bits) - 1 : 4095;
    for (int i = 0; i < n; i++) {
        int value = camera.linked ? from_bench.pixels[i]
                                  : (3 * (i % camera.width) + 7 * (i / camera.width)) & full_scale;
        if (camera.bytes == 2) ((uint16_t *)buffer->data)[i] = (uint16_t)value;
        else buffer->data[i] = (unsigned char)value;
    }
    stream.next = k + 1;
    long frame_count = first_frame + k;
    buffer->id = (uint64_t)(frame_count <= 65535 ? frame_count : (frame_count - 1) % 65535 + 1);
    buffer->width = camera.width;
    buffer->height = camera.height;
    return 1;
}

static void *pop_buffer(const char *name, struct si_function *function, void *handle, uint64_t wait_us) {
    struct si_rule rule = si_begin_call(function);
    if (handle != &stream || !stream.alive || !camera.acquiring) {
        si_report_violation("%s: no stream, or the camera does not acquire", name);
        return NULL;
    }
    if (stream.n == 0) {
        si_report_violation("%s: no buffer is left; push them back", name);
        return NULL;
    }
    camera.waiting++;
    Buffer *buffer = stream.queue[0];
    int filled = 0;
    if (rule.action == SI_TIMEOUT || si_unplugged) si_sleep_until(si_now_ns() + (int64_t)wait_us * 1000);
    else filled = fill_buffer(buffer, wait_us, &rule);
    camera.waiting--;
    if (!filled) return NULL;
    buffer->status = rule.action == SI_ERROR ? (int)rule.argument : 0;
    buffer->owned_by_stream = 0;
    memmove(stream.queue, stream.queue + 1, sizeof *stream.queue * (size_t)--stream.n);
    return buffer;
}

EXPORT void *arv_stream_try_pop_buffer(void *handle) {
    static struct si_function f = {.name = "arv_stream_try_pop_buffer"};
    return pop_buffer("arv_stream_try_pop_buffer", &f, handle, 0);
}

EXPORT void *arv_stream_timeout_pop_buffer(void *handle, uint64_t wait_us) {
    static struct si_function f = {.name = "arv_stream_timeout_pop_buffer"};
    si_log("arv_stream_timeout_pop_buffer %lu", (unsigned long)wait_us);
    return pop_buffer("arv_stream_timeout_pop_buffer", &f, handle, wait_us);
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
