/* Stand-in of XIMEA's libm3api: one MQ013MG-ON, strict about order, ranges, types and structure sizes.
 *
 * Properties (set KEY VALUE): serial, width_inc, height_inc, padding (bytes after each row), first_frame (its
 * number), real_time (0: frames are always ready), attenuation (halvings of the light), trigger_hz (edges on
 * the input; 0: none), disconnect_code.
 */
#define _GNU_SOURCE
#include "stand_in.h"

#include <stdatomic.h>

typedef int XI_RETURN;
typedef void *HANDLE;
typedef uint32_t DWORD;
typedef int XI_PRM_TYPE;
enum { INTEGER = 0, FLOATING = 1, TEXT = 2, INTEGER64 = 6 };
enum {
    OK = 0, BAD_HANDLE = 1, TIMEOUT = 10, BAD_ARGUMENT = 11, ALREADY_STARTED = 41, STOPPED = 45, RESET = 55,
    NO_DEVICE = 56, LOCKED = 57, SMALL_BUFFER = 58, UNKNOWN = 100, WRONG_VALUE = 101, WRONG_TYPE = 103,
    WRONG_SIZE = 104, UNSUPPORTED = 106, READ_ONLY = 109, BANDWIDTH = 111, NOT_NOW = 114, CONTEXT = 119
};

typedef struct {
    DWORD size;
    void *bp;
    DWORD bp_size;
    int frm;
    DWORD width, height, nframe, tsSec, tsUSec, GPI_level, black_level, padding_x;
    DWORD AbsoluteOffsetX, AbsoluteOffsetY, transport_frm, img_desc[28];
    DWORD DownsamplingX, DownsamplingY, flags, exposure_time_us;
    float gain_db;
    DWORD acq_nframe, image_user_data, exposure_sub_times_us[5];
    double data_saturation;
    float wb_red, wb_green, wb_blue;
    DWORD lg_black_level, hg_black_level, lg_range, hg_range;
    float gain_ratio, fDownsamplingX, fDownsamplingY;
    int color_filter_array;
} XI_IMG;
_Static_assert(sizeof(XI_IMG) == 288 && offsetof(XI_IMG, acq_nframe) == 200 && offsetof(XI_IMG, bp) == 8 &&
                   offsetof(XI_IMG, padding_x) == 52 && offsetof(XI_IMG, img_desc) == 68 &&
                   offsetof(XI_IMG, data_saturation) == 232 && offsetof(XI_IMG, color_filter_array) == 280,
               "XI_IMG as the library of version 4.27 lays it out");
/* Sizes of the structure that versions 1 to 16 have had, and with its padding. */
static const DWORD sizes[] = {36,  48,  52,  56,  64,  68,  180, 192, 200,
                              204, 228, 240, 252, 272, 280, 284, 288};

#define SENSOR_W 1280
#define SENSOR_H 1024
#define QUEUE_MAX 64
#define PITCH_MAX (2 * SENSOR_W + 256)

enum { READ = 1, WRITE = 2, READ_WRITE = 3, IDLE_ONLY = 4 }; /* the last: not writable while acquiring */
struct parameter {
    const char *name;
    int type, access;
    double low, high, step, initial, value;
};
enum {
    EXPOSURE, GAIN, FRAMERATE, TIMING, WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, FORMAT, OUT_BITS, SENSOR_BITS,
    DATA_BITS, DOWNSAMPLING, DOWN_TYPE, QUEUE, RECENT, POLICY, TRIGGER, COUNTER, LIMIT, CHIP_TEMP, N_NAMED
};
static struct parameter parameters[] = {
    [EXPOSURE] = {"exposure", FLOATING, READ_WRITE, 28, 1000000, 1, 10000, 0},
    [GAIN] = {"gain", FLOATING, READ_WRITE, 0, 12, 0.1, 0, 0},
    [FRAMERATE] = {"framerate", FLOATING, READ_WRITE, 0.8, 0, 0, 30, 0},
    [TIMING] = {"acq_timing_mode", INTEGER, READ_WRITE | IDLE_ONLY, 0, 2, 1, 0, 0},
    [WIDTH] = {"width", INTEGER, READ_WRITE | IDLE_ONLY, 16, 0, 0, SENSOR_W, 0},
    [HEIGHT] = {"height", INTEGER, READ_WRITE | IDLE_ONLY, 2, 0, 0, SENSOR_H, 0},
    [OFFSET_X] = {"offsetX", INTEGER, READ_WRITE | IDLE_ONLY, 0, 0, 0, 0, 0},
    [OFFSET_Y] = {"offsetY", INTEGER, READ_WRITE | IDLE_ONLY, 0, 0, 0, 0, 0},
    [FORMAT] = {"imgdataformat", INTEGER, READ_WRITE | IDLE_ONLY, 0, 7, 1, 0, 0},
    [OUT_BITS] = {"output_bit_depth", INTEGER, READ_WRITE | IDLE_ONLY, 8, 10, 2, 8, 0},
    [SENSOR_BITS] = {"sensor_bit_depth", INTEGER, READ_WRITE | IDLE_ONLY, 8, 10, 2, 8, 0},
    [DATA_BITS] = {"image_data_bit_depth", INTEGER, READ_WRITE | IDLE_ONLY, 8, 10, 2, 8, 0},
    [DOWNSAMPLING] = {"downsampling", INTEGER, READ_WRITE | IDLE_ONLY, 1, 2, 1, 1, 0},
    [DOWN_TYPE] = {"downsampling_type", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 0, 0},
    [QUEUE] = {"buffers_queue_size", INTEGER, READ_WRITE | IDLE_ONLY, 2, QUEUE_MAX, 1, 4, 0},
    [RECENT] = {"recent_frame", INTEGER, READ_WRITE, 0, 1, 1, 0, 0},
    [POLICY] = {"buffer_policy", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 0, 0},
    [TRIGGER] = {"trigger_source", INTEGER, READ_WRITE | IDLE_ONLY, 0, 5, 1, 0, 0},
    [COUNTER] = {"counter_selector", INTEGER, READ_WRITE, 0, 2, 1, 0, 0},
    [LIMIT] = {"limit_bandwidth", INTEGER, READ_WRITE | IDLE_ONLY, 1, 3000, 1, 2400, 0},
    [CHIP_TEMP] = {"chip_temp", FLOATING, READ, 0, 100, 0, 41.5, 0},
    {"output_bit_packing", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 0, 0},
    {"acq_buffer_size", INTEGER, READ_WRITE | IDLE_ONLY, 1 << 16, 1 << 30, 1, 1 << 24, 0},
    {"acq_transport_buffer_commit", INTEGER, READ_WRITE | IDLE_ONLY, 1, 32, 1, 8, 0},
    {"trigger_software", INTEGER, WRITE, 0, 1, 1, 0, 0},
    {"trigger_selector", INTEGER, READ_WRITE | IDLE_ONLY, 0, 8, 1, 0, 0},
    {"trigger_overlap", INTEGER, READ_WRITE | IDLE_ONLY, 0, 2, 1, 0, 0},
    {"gpi_selector", INTEGER, READ_WRITE | IDLE_ONLY, 1, 1, 1, 1, 0},
    {"gpi_mode", INTEGER, READ_WRITE | IDLE_ONLY, 0, 2, 1, 0, 0},
    {"gpo_selector", INTEGER, READ_WRITE | IDLE_ONLY, 1, 1, 1, 1, 0},
    {"gpo_mode", INTEGER, READ_WRITE | IDLE_ONLY, 0, 15, 1, 0, 0},
    {"auto_bandwidth_calculation", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 1, 0},
    {"available_bandwidth", INTEGER, READ, 2400, 2400, 1, 2400, 0},
    {"aeag", INTEGER, READ_WRITE, 0, 1, 1, 0, 0},
    {"sensor_feature_selector", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 0, 0},
    {"sensor_feature_value", INTEGER, READ_WRITE | IDLE_ONLY, 0, 1, 1, 0, 0},
    {"image_black_level", INTEGER, READ, 0, 100, 1, 8, 0},
    {"isexist", INTEGER, READ, 0, 1, 1, 1, 0},
    {"debug_level", INTEGER, READ_WRITE, 0, 5, 1, 1, 0},
    {"counter_value", INTEGER, READ, 0, 0, 1, 0, 0},
};
#define N_PARAMETERS (int)(sizeof parameters / sizeof *parameters)
#define CURRENT(which) (parameters[which].value)

struct camera {
    atomic_int open, acquiring, imaging;
    struct si_connection bench;
    int linked;
    int64_t start_ns;
    double period_ns;
    long delivered; /* number of the newest frame delivered, from 0; -1 none */
    long counters[3];
};
static struct camera camera;
static char serial[64];
static int width_inc, height_inc, padding, first_frame, real_time, attenuation, disconnect_code;
static double trigger_hz;
static uint16_t ring[QUEUE_MAX][SENSOR_H * PITCH_MAX / 2]; /* bytes for 8-bit formats */
static struct {
    int64_t index, exposed_ns;
    uint16_t pixels[SENSOR_W * SENSOR_H];
} from_bench;

static void defaults(void) {
    for (int k = 0; k < N_PARAMETERS; k++) parameters[k].value = parameters[k].initial;
}

static void si_reset_device(void) {
    if (camera.linked) si_disconnect_bench(&camera.bench);
    memset(&camera, 0, sizeof camera);
    camera.bench.fd = -1;
    defaults();
    snprintf(serial, sizeof serial, "SIMWFS");
    width_inc = 8;
    height_inc = 2;
    real_time = 1;
    disconnect_code = BAD_HANDLE;
    padding = first_frame = attenuation = 0;
    trigger_hz = 0;
}

static int si_set_property(const char *key, const char *value) {
    int integer = atoi(value);
    if (strcmp(key, "serial") == 0) return snprintf(serial, sizeof serial, "%s", value) > 0;
    if (strcmp(key, "width_inc") == 0) return (width_inc = integer) > 0;
    if (strcmp(key, "height_inc") == 0) return (height_inc = integer) > 0;
    if (strcmp(key, "padding") == 0) return (padding = integer) >= 0 && padding <= 256 && padding % 2 == 0;
    if (strcmp(key, "first_frame") == 0) return (first_frame = integer) >= 0;
    if (strcmp(key, "attenuation") == 0) return (attenuation = integer) >= 0;
    if (strcmp(key, "real_time") == 0) return (real_time = integer) >= 0;
    if (strcmp(key, "disconnect_code") == 0) return (disconnect_code = integer) > 0;
    if (strcmp(key, "trigger_hz") == 0) return (trigger_hz = atof(value)) >= 0;
    return 0;
}

EXPORT const char *escape_stand_in(void) { return "libm3api stand-in"; }

/* ---- limits of the sensor ------------------------------------------------------------------------------ */
static double readout_us(void) { return 20 + 4.65 * CURRENT(HEIGHT); }

static double fastest_hz(void) { return 1e6 / fmax(readout_us(), CURRENT(EXPOSURE) + 30); }

static double present_hz(void) {
    return CURRENT(TIMING) == 1 ? fmin(CURRENT(FRAMERATE), fastest_hz()) : fastest_hz();
}

static void limits_of(int which, double *low, double *high, double *step) {
    double width = SENSOR_W / CURRENT(DOWNSAMPLING), height = SENSOR_H / CURRENT(DOWNSAMPLING);
    *low = parameters[which].low, *high = parameters[which].high, *step = parameters[which].step;
    switch (which) {
    case WIDTH: *high = width - CURRENT(OFFSET_X), *step = width_inc; break;
    case HEIGHT: *high = height - CURRENT(OFFSET_Y), *step = height_inc; break;
    case OFFSET_X: *high = width - CURRENT(WIDTH), *step = width_inc; break;
    case OFFSET_Y: *high = height - CURRENT(HEIGHT), *step = height_inc; break;
    case FRAMERATE:
        *high = fastest_hz();
        if (CURRENT(TIMING) != 1) *low = *high = present_hz();
        break;
    default: break;
    }
}

static int bits(void) { return CURRENT(FORMAT) == 1 || CURRENT(FORMAT) == 6 ? (int)CURRENT(DATA_BITS) : 8; }
static int bytes_per_pixel(void) { return CURRENT(FORMAT) == 1 || CURRENT(FORMAT) == 6 ? 2 : 1; }

static int pitch_bytes(void) { return (int)CURRENT(WIDTH) * bytes_per_pixel() + padding; }

/* The test image: pixel (x, y) is 3 x + 7 y, but the first one is the frame number. */
static void write_pixel(int slot, int x, int y, int value) {
    unsigned char *row = (unsigned char *)ring[slot] + y * pitch_bytes();
    if (bytes_per_pixel() == 2) ((uint16_t *)row)[x] = (uint16_t)value;
    else row[x] = (unsigned char)value;
}

/* Checks at the beginning of every call; 1 if the call ends here, with its result in *outcome. */
static int call_rejected(HANDLE handle, struct si_function *function, struct si_rule *rule,
                         XI_RETURN *outcome) {
    *rule = si_begin_call(function);
    if (rule->action == SI_UNPLUG && rule->argument) disconnect_code = (int)rule->argument;
    if (handle != &camera || !camera.open) {
        si_report_violation("%s: the handle is not that of an open camera", function->name);
        return *outcome = BAD_HANDLE, 1;
    }
    if (si_unplugged) return *outcome = disconnect_code, 1;
    if (rule->action == SI_ERROR) return *outcome = (int)rule->argument, 1;
    if (rule->action == SI_IGNORE) return *outcome = OK, 1;
    if (rule->action == SI_RESET) {
        camera.acquiring = 0;
        defaults();
        return *outcome = RESET, 1;
    }
    return 0;
}

/* ---- opening and closing ----------------------------------------------------------------------------- */
static XI_RETURN open_camera(struct si_function *function, const char *wanted, HANDLE *handle) {
    struct si_rule rule = si_begin_call(function);
    if (si_unplugged) return NO_DEVICE;
    if (rule.action == SI_ERROR) return (int)rule.argument;
    if (handle == NULL) return si_report_violation("%s: null pointer", function->name), BAD_ARGUMENT;
    if (camera.open) {
        si_report_violation("%s: the camera has an owner already", function->name);
        return LOCKED;
    }
    uint32_t greeting[1] = {0};
    int linked = si_connect_bench(&camera.bench, "wfs", wanted ? wanted : "", greeting, sizeof greeting);
    if (linked < 0 || (linked == 0 && wanted && strcmp(wanted, serial) != 0)) return NO_DEVICE;
    if (linked) snprintf(serial, sizeof serial, "%s", wanted);
    camera.linked = linked;
    camera.acquiring = camera.imaging = 0;
    camera.open = 1;
    defaults();
    *handle = &camera;
    return OK;
}

EXPORT XI_RETURN xiGetNumberDevices(DWORD *n) {
    static struct si_function f = {.name = "xiGetNumberDevices"};
    si_log("xiGetNumberDevices");
    si_begin_call(&f);
    if (n == NULL) return BAD_ARGUMENT;
    *n = !si_unplugged;
    return OK;
}

EXPORT XI_RETURN xiGetDeviceInfoString(DWORD index, const char *name, char *value, DWORD size) {
    static struct si_function f = {.name = "xiGetDeviceInfoString"};
    si_log("xiGetDeviceInfoString %u %s", index, name);
    si_begin_call(&f);
    if (si_unplugged || index != 0) return NO_DEVICE;
    if (strcmp(name, "device_sn") == 0) snprintf(value, size, "%s", serial);
    else if (strcmp(name, "device_name") == 0) snprintf(value, size, "MQ013MG-ON");
    else return UNKNOWN;
    return OK;
}

EXPORT XI_RETURN xiGetDeviceInfoInt(DWORD index, const char *name, int *value) {
    static struct si_function f = {.name = "xiGetDeviceInfoInt"};
    si_log("xiGetDeviceInfoInt %u %s", index, name);
    si_begin_call(&f);
    if (si_unplugged || index != 0) return NO_DEVICE;
    if (strcmp(name, "isexist") != 0) return UNKNOWN;
    *value = 1;
    return OK;
}

EXPORT XI_RETURN xiOpenDevice(DWORD index, HANDLE *handle) {
    static struct si_function f = {.name = "xiOpenDevice"};
    si_log("xiOpenDevice %u", index);
    return index ? NO_DEVICE : open_camera(&f, NULL, handle);
}

EXPORT XI_RETURN xiOpenDeviceBy(int selector, const char *value, HANDLE *handle) {
    static struct si_function f = {.name = "xiOpenDeviceBy"};
    si_log("xiOpenDeviceBy %d %s", selector, value ? value : "NULL");
    return selector == 1 ? open_camera(&f, value ? value : "", handle) : UNSUPPORTED;
}

EXPORT XI_RETURN xiCloseDevice(HANDLE handle) {
    static struct si_function f = {.name = "xiCloseDevice"};
    struct si_rule rule;
    XI_RETURN outcome = OK;
    si_log("xiCloseDevice");
    int no = call_rejected(handle, &f, &rule, &outcome);
    if (handle != &camera || !camera.open) return outcome;
    if (camera.imaging) si_report_violation("xiCloseDevice: xiGetImage is still waiting in another thread");
    if (camera.acquiring && !si_unplugged)
        si_report_violation("xiCloseDevice: the camera is acquiring; xiStopAcquisition first");
    camera.open = camera.acquiring = 0;
    si_disconnect_bench(&camera.bench);
    return no ? outcome : OK;
}

/* ---- parameters -------------------------------------------------------------------------------------- */
/* The parameter of a name without its suffix (":min" ...), which is returned; NULL if it is unknown. */
static struct parameter *parameter_of(const char *name, const char **suffix) {
    size_t length = name ? strcspn(name, ":") : 0;
    *suffix = name + length;
    for (int k = 0; k < N_PARAMETERS; k++)
        if (length && strlen(parameters[k].name) == length && strncmp(name, parameters[k].name, length) == 0)
            return &parameters[k];
    return NULL;
}

static XI_RETURN number_of(const char *name, int type, double *out) {
    const char *suffix;
    struct parameter *p = parameter_of(name, &suffix);
    if (p == NULL) return UNKNOWN;
    if (p->type != type) return si_report_violation("%s has another type", name), WRONG_TYPE;
    if (!(p->access & READ)) return UNSUPPORTED;
    double low, high, step;
    limits_of((int)(p - parameters), &low, &high, &step);
    *out = p->value;
    if (p == &parameters[FRAMERATE]) *out = present_hz();
    if (strcmp(p->name, "counter_value") == 0) *out = (double)camera.counters[(int)CURRENT(COUNTER)];
    if (strcmp(suffix, ":min") == 0) *out = low;
    else if (strcmp(suffix, ":max") == 0) *out = high;
    else if (strcmp(suffix, ":inc") == 0) *out = step;
    else if (*suffix) return UNSUPPORTED;
    return OK;
}

static XI_RETURN set_number(const char *name, int type, double x) {
    const char *suffix;
    struct parameter *p = parameter_of(name, &suffix);
    if (p == NULL) return UNKNOWN;
    if (p->type != type) return si_report_violation("%s has another type", name), WRONG_TYPE;
    if (*suffix) return UNSUPPORTED;
    if (!(p->access & WRITE)) return READ_ONLY;
    if ((p->access & IDLE_ONLY) && camera.acquiring) {
        si_report_violation("%s cannot be set while the camera is acquiring", name);
        return NOT_NOW;
    }
    if (p == &parameters[FRAMERATE] && CURRENT(TIMING) != 1) return CONTEXT;
    double low, high, step;
    limits_of((int)(p - parameters), &low, &high, &step);
    if (!(x >= low * (1 - 1e-6) && x <= high * (1 + 1e-6))) {
        si_report_violation("%s = %g lies outside %g..%g", name, x, low, high);
        return BAD_ARGUMENT;
    }
    if (type == INTEGER && step > 1 && fmod(x - low, step) != 0) {
        si_report_violation("%s = %g does not fit its increment of %g", name, x, step);
        return WRONG_VALUE;
    }
    if (type == FLOATING && step > 0) x = round(x / step) * step;
    if (p == &parameters[FRAMERATE]) x = 1e6 / ceil(1e6 / x - 1e-3);
    p->value = x;
    if (p == &parameters[DOWNSAMPLING]) {
        CURRENT(WIDTH) = SENSOR_W / x;
        CURRENT(HEIGHT) = SENSOR_H / x;
        CURRENT(OFFSET_X) = CURRENT(OFFSET_Y) = 0;
    }
    return OK;
}

#define BEGIN(title, ...)                                                                                     \
    static struct si_function f = {.name = title};                                                            \
    struct si_rule rule;                                                                                      \
    XI_RETURN outcome;                                                                                        \
    si_log(title __VA_ARGS__);                                                                                \
    if (call_rejected(handle, &f, &rule, &outcome)) return outcome

EXPORT XI_RETURN xiSetParamInt(HANDLE handle, const char *name, int value) {
    BEGIN("xiSetParamInt", " %s %d", name, value);
    return set_number(name, INTEGER, value);
}

EXPORT XI_RETURN xiSetParamFloat(HANDLE handle, const char *name, float value) {
    BEGIN("xiSetParamFloat", " %s %g", name, (double)value);
    return set_number(name, FLOATING, value);
}

EXPORT XI_RETURN xiSetParamString(HANDLE handle, const char *name, void *value, DWORD size) {
    BEGIN("xiSetParamString", " %s %.*s", name, (int)size, (const char *)value);
    return UNKNOWN;
}

EXPORT XI_RETURN xiGetParamInt(HANDLE handle, const char *name, int *value) {
    BEGIN("xiGetParamInt", " %s", name);
    double x;
    outcome = number_of(name, INTEGER, &x);
    if (outcome == OK) *value = (int)x;
    return outcome;
}

EXPORT XI_RETURN xiGetParamFloat(HANDLE handle, const char *name, float *value) {
    BEGIN("xiGetParamFloat", " %s", name);
    double x;
    outcome = number_of(name, FLOATING, &x);
    if (outcome == OK) *value = (float)x;
    return outcome;
}

static XI_RETURN text_of(const char *name, char *value, DWORD size) {
    const char *text = strcmp(name, "device_sn") == 0     ? serial
                       : strcmp(name, "device_name") == 0 ? "MQ013MG-ON"
                       : strcmp(name, "api_version") == 0 ? "4.27.13.3 stand-in"
                                                          : NULL;
    if (text == NULL) return UNKNOWN;
    return snprintf(value, size, "%s", text) < (int)size ? OK : SMALL_BUFFER;
}

EXPORT XI_RETURN xiGetParamString(HANDLE handle, const char *name, void *value, DWORD size) {
    BEGIN("xiGetParamString", " %s", name);
    return text_of(name, value, size);
}

EXPORT XI_RETURN xiSetParam(HANDLE handle, const char *name, void *value, DWORD size, XI_PRM_TYPE type) {
    BEGIN("xiSetParam", " %s size %u type %d", name, size, type);
    if (type != INTEGER && type != FLOATING) return WRONG_TYPE;
    if (size != 4) return si_report_violation("xiSetParam: %s of %u bytes", name, size), WRONG_SIZE;
    return set_number(name, type, type == INTEGER ? *(int *)value : *(float *)value);
}

EXPORT XI_RETURN xiGetParam(HANDLE handle, const char *name, void *value, DWORD *size, XI_PRM_TYPE *type) {
    BEGIN("xiGetParam", " %s size %u type %d", name, *size, *type);
    if (*type == TEXT) return text_of(name, value, *size);
    if (*type != INTEGER && *type != FLOATING) return WRONG_TYPE;
    if (*size < 4) return si_report_violation("xiGetParam: %s of %u bytes", name, *size), WRONG_SIZE;
    double x;
    outcome = number_of(name, *type, &x);
    if (outcome != OK) return outcome;
    if (*type == INTEGER) *(int *)value = (int)x;
    else *(float *)value = (float)x;
    *size = 4;
    return OK;
}

/* ---- acquisition ------------------------------------------------------------------------------------- */
static XI_RETURN start_on_bench(void) {
    struct {
        uint32_t region[4];
        double exposure_us, framerate_hz, gain_db;
    } wanted = {{(uint32_t)CURRENT(OFFSET_X), (uint32_t)CURRENT(OFFSET_Y), (uint32_t)CURRENT(WIDTH),
                 (uint32_t)CURRENT(HEIGHT)},
                CURRENT(EXPOSURE), present_hz(), CURRENT(GAIN)};
    int status = si_request(&camera.bench, SI_START, &wanted, sizeof wanted, NULL, 0, NULL);
    return status == 0 ? OK : status < 0 ? disconnect_code : BAD_ARGUMENT;
}

EXPORT XI_RETURN xiStartAcquisition(HANDLE handle) {
    BEGIN("xiStartAcquisition", "%s", "");
    if (camera.acquiring) return ALREADY_STARTED;
    double rate = present_hz();
    double bit_rate = CURRENT(WIDTH) * CURRENT(HEIGHT) * 8 * bytes_per_pixel() * rate;
    if (bit_rate > 1e6 * CURRENT(LIMIT)) return BANDWIDTH;
    if (CURRENT(TRIGGER) != 0) rate = trigger_hz / ceil(trigger_hz / fastest_hz() - 1e-9);
    camera.period_ns = rate > 0 ? 1e9 / rate : INFINITY;
    camera.start_ns = si_now_ns();
    camera.delivered = -1;
    memset(camera.counters, 0, sizeof camera.counters);
    if (camera.linked && (outcome = start_on_bench()) != OK) return outcome;
    int top = (1 << bits()) - 1;
    for (int slot = 0; slot < (int)CURRENT(QUEUE); slot++) {
        memset(ring[slot], 0xFF, (size_t)(pitch_bytes() * (int)CURRENT(HEIGHT)));
        for (int y = 0; y < (int)CURRENT(HEIGHT); y++)
            for (int x = 0; x < (int)CURRENT(WIDTH); x++)
                write_pixel(slot, x, y, (3 * x + 7 * y) & (top >> attenuation));
    }
    camera.acquiring = 1;
    return OK;
}

EXPORT XI_RETURN xiStopAcquisition(HANDLE handle) {
    BEGIN("xiStopAcquisition", "%s", "");
    if (camera.imaging)
        si_report_violation("xiStopAcquisition: xiGetImage is still waiting in another thread");
    if (!camera.acquiring) return STOPPED;
    camera.acquiring = 0;
    if (camera.linked) si_request(&camera.bench, SI_STOP, NULL, 0, NULL, 0, NULL);
    return OK;
}

/* Wait for the next frame; its number, or -1 after the time-out. */
static long next_frame(DWORD timeout_ms, long n_dropped) {
    int64_t now = si_now_ns(), deadline = now + (int64_t)timeout_ms * 1000000;
    long next = camera.delivered + 1 + n_dropped;
    if (real_time) {
        long newest = (long)((double)(now - camera.start_ns) / camera.period_ns) - 1;
        long oldest = CURRENT(RECENT) ? newest : newest - (long)CURRENT(QUEUE) + 1;
        if (oldest > next) {
            camera.counters[1] += oldest - next;
            next = oldest;
        }
        double ready = (double)camera.start_ns + (double)(next + 1) * camera.period_ns;
        while (ready > (double)(now = si_now_ns())) {
            if (now >= deadline || !camera.acquiring || si_unplugged) return -1;
            double until = fmin(fmin(ready, (double)deadline), (double)now + 5e6);
            si_sleep_until((int64_t)until + 1);
        }
    }
    return next;
}

static XI_RETURN read_bench_frame(DWORD timeout_ms, int64_t *stamp_ns, long *number) {
    int width = (int)CURRENT(WIDTH), height = (int)CURRENT(HEIGHT);
    double wait_s = timeout_ms * 1e-3;
    uint32_t got = 0;
    int status = si_request(&camera.bench, SI_FRAME, &wait_s, sizeof wait_s, &from_bench,
                            sizeof from_bench, &got);
    if (status == 1) return TIMEOUT;
    if (status != 0 || got != 16 + 2u * (uint32_t)(width * height)) return disconnect_code;
    *number = (long)from_bench.index;
    *stamp_ns = from_bench.exposed_ns;
    int slot = (int)(*number % (long)CURRENT(QUEUE));
    for (int y = 0; y < height; y++)
        memcpy((unsigned char *)ring[slot] + y * pitch_bytes(), from_bench.pixels + y * width,
               2 * (size_t)width);
    return OK;
}

static XI_RETURN generate_frame(DWORD timeout_ms, long n_dropped, int64_t *stamp_ns, long *number) {
    *number = next_frame(timeout_ms, n_dropped);
    if (*number >= 0) camera.counters[0] += n_dropped;
    if (*number < 0) return si_unplugged ? disconnect_code : TIMEOUT;
    *stamp_ns = camera.start_ns + (int64_t)((double)(*number + 1) * (real_time ? camera.period_ns : 1e6));
    int slots = (int)CURRENT(QUEUE), top = (1 << bits()) - 1;
    /* The real ring is overwritten: a buffer that was delivered before changes. */
    if (si_recording && camera.delivered >= 0) write_pixel((int)(camera.delivered % slots), 1, 0, top);
    write_pixel((int)(*number % slots), 0, 0, (int)*number & (top >> attenuation));
    write_pixel((int)(*number % slots), 1, 0, 3);
    return OK;
}

static XI_RETURN acquire_image(XI_IMG *image, DWORD timeout_ms, long n_dropped, XI_IMG *full) {
    int64_t stamp_ns = 0;
    long number = 0;
    XI_RETURN outcome = camera.linked ? read_bench_frame(timeout_ms, &stamp_ns, &number)
                                      : generate_frame(timeout_ms, n_dropped, &stamp_ns, &number);
    if (outcome != OK) return outcome;
    camera.delivered = number;
    camera.counters[2]++;
    full->bp = ring[number % (long)CURRENT(QUEUE)];
    full->bp_size = (DWORD)(pitch_bytes() * (int)CURRENT(HEIGHT));
    if (CURRENT(POLICY) == 1) {
        if (image->bp == NULL || image->bp_size < full->bp_size) return SMALL_BUFFER;
        memcpy(image->bp, full->bp, full->bp_size);
        full->bp = image->bp;
    }
    full->width = (DWORD)CURRENT(WIDTH);
    full->height = (DWORD)CURRENT(HEIGHT);
    full->acq_nframe = (DWORD)(number + first_frame);
    /* The library counts frames that reached it; acq_nframe also those lost on the cable. */
    full->nframe = full->acq_nframe - (DWORD)camera.counters[0];
    full->tsSec = (DWORD)(stamp_ns / 1000000000);
    full->tsUSec = (DWORD)(stamp_ns / 1000 % 1000000);
    return OK;
}

EXPORT XI_RETURN xiGetImage(HANDLE handle, DWORD timeout_ms, XI_IMG *image) {
    BEGIN("xiGetImage", " %u size %u", timeout_ms, image ? image->size : 0);
    int known = 0;
    for (size_t k = 0; image && k < sizeof sizes / sizeof *sizes; k++) known |= image->size == sizes[k];
    if (!known) {
        si_report_violation("xiGetImage: no version of this library has an XI_IMG of %u bytes",
                            image ? image->size : 0);
        return BAD_ARGUMENT;
    }
    if (!camera.acquiring) return STOPPED;
    if (rule.action == SI_TIMEOUT) {
        si_sleep_until(si_now_ns() + 1000000 * (int64_t)fmin((double)rule.argument, timeout_ms));
        return TIMEOUT;
    }
    XI_IMG full = {.size = image->size, .frm = (int)CURRENT(FORMAT), .padding_x = (DWORD)padding,
                   .AbsoluteOffsetX = (DWORD)CURRENT(OFFSET_X), .AbsoluteOffsetY = (DWORD)CURRENT(OFFSET_Y),
                   .DownsamplingX = (DWORD)CURRENT(DOWNSAMPLING),
                   .DownsamplingY = (DWORD)CURRENT(DOWNSAMPLING),
                   .exposure_time_us = (DWORD)CURRENT(EXPOSURE), .gain_db = (float)CURRENT(GAIN),
                   .data_saturation = (1 << bits()) - 1, .gain_ratio = 1};
    camera.imaging++;
    outcome = acquire_image(image, timeout_ms, rule.action == SI_DROP ? rule.argument : 0, &full);
    camera.imaging--;
    if (outcome != OK) return outcome;
    DWORD fill = image->size;
    if (rule.action == SI_SHORT && (DWORD)rule.argument < fill) fill = (DWORD)rule.argument;
    memcpy(image, &full, fill < sizeof full ? fill : sizeof full);
    return OK;
}

/* Nanoseconds per xiGetImage called from C: the lower limit for any driver. */
EXPORT double escape_stand_in_time(HANDLE handle, XI_IMG *image, long n) {
    int64_t start = si_now_ns();
    for (long k = 0; k < n; k++)
        if (xiGetImage(handle, 1000, image) != OK) return NAN;
    return (double)(si_now_ns() - start) / (double)n;
}
