/* Stand-in of ALPAO's libasdk: one mirror, the C calls of asdkDM.h, strict about their order.
 *
 * Properties (set KEY VALUE): serial, actuators, range (refuse, ignore or accept values beyond 1),
 * errors_stay (1: reading an error does not remove it), triggers (0: no trigger inputs), trigger_in (state that
 * another program has left). With a trigger, each asdkSendPattern needs TriggerIn set since the one before.
 */
#define _GNU_SOURCE
#include "stand_in.h"

typedef double Scalar;
typedef uint32_t UInt;
typedef int32_t Int;
typedef int COMPL_STAT;
#define SUCCESS 0
#define FAILURE (-1)
#define MAX_ACT 4096
#define MAX_DM 8
#define STACK 64

enum range_mode { REFUSE, SKIP, ACCEPT };

typedef struct asdkDM {
    int open;     /* 0 never or released, 1 ready, 2 failed to initialise */
    int playing;  /* a pattern is being sent: repeats left, -1 endless */
    int64_t played_until;
    int not_at_zero;  /* moved, and not reset since */
    int linked;       /* to a simulated bench */
    Scalar shape[MAX_ACT];
    struct si_connection bench;
} asdkDM;

struct parameter {
    const char *name;
    int gets, sets;
    Scalar low, high, initial, value;
};

static struct parameter parameters[] = {
    {"NbOfActuator", 1, 0, 0, 0, 0, 0},
    {"VersionInfo", 1, 0, 0, 0, 3040500612.0, 0},
    {"ItfState", 1, 0, 0, 0, 0, 0},
    {"SyncMode", 0, 1, 0, 1, 0, 0},
    {"AckTimeout", 1, 1, 0, 60000, 1000, 0},
    {"TriggerMode", 0, 1, 0, 1, 0, 0},
    {"TriggerIn", 0, 1, 0, 2, 0, 0},
    {"UseException", 1, 1, 0, 1, 0, 0},
    {"LogPrintLevel", 1, 1, 0, 4, 1, 0},
    {"LogDump", 0, 1, 1, 1, 0, 0},
    {"DacReset", 0, 1, 1, 1, 0, 0},
    {"NbSteps", 1, 1, 1, 1000, 1, 0},
    {"Gain", 1, 1, 0, 65535, 8191, 0},
    {"ResetOnClose", 1, 1, 0, 1, 0, 0},
};
#define N_PARAMETERS (int)(sizeof parameters / sizeof *parameters)

static asdkDM mirrors[MAX_DM];
static char configured_serial[64];
static int n_act, errors_stay, has_triggers, trigger_is_set;
static enum range_mode range_mode;
static struct {
    UInt number;
    char text[128];
} errors[STACK];
static int n_errors;
static Scalar applied_shape[MAX_ACT];
static long n_transfers;

static struct parameter *parameter_of(const char *name) {
    for (int k = 0; k < N_PARAMETERS; k++)
        if (name && strcasecmp(name, parameters[k].name) == 0) return &parameters[k];
    return NULL;
}

static void si_reset_device(void) {
    for (int k = 0; k < MAX_DM; k++) {
        if (mirrors[k].open) si_disconnect_bench(&mirrors[k].bench);
        memset(&mirrors[k], 0, sizeof mirrors[k]);
        mirrors[k].bench.fd = -1;
    }
    for (int k = 0; k < N_PARAMETERS; k++) parameters[k].value = parameters[k].initial;
    snprintf(configured_serial, sizeof configured_serial, "SIM97");
    n_act = 97;
    errors_stay = n_errors = 0;
    has_triggers = trigger_is_set = 1;
    n_transfers = 0;
    range_mode = REFUSE;
    memset(applied_shape, 0, sizeof applied_shape);
}

static int si_set_property(const char *key, const char *value) {
    if (strcmp(key, "serial") == 0)
        return snprintf(configured_serial, sizeof configured_serial, "%s", value) > 0;
    if (strcmp(key, "actuators") == 0) return (n_act = atoi(value)) >= 1 && n_act <= MAX_ACT;
    if (strcmp(key, "errors_stay") == 0) return (errors_stay = atoi(value)) >= 0;
    if (strcmp(key, "triggers") == 0) return (has_triggers = atoi(value)) >= 0;
    if (strcmp(key, "trigger_in") == 0) return parameter_of("TriggerIn")->value = atoi(value), 1;
    if (strcmp(key, "range") == 0) {
        static const char *const names[] = {"refuse", "ignore", "accept"};
        for (int k = 0; k < 3; k++)
            if (strcmp(value, names[k]) == 0) return (range_mode = (enum range_mode)k), 1;
    }
    return 0;
}

EXPORT const char *escape_stand_in(void) { return "libasdk stand-in"; }

/* Copy the present shape; returns the number of transfers that reached the mirror. */
EXPORT long escape_stand_in_shape(Scalar *out, int n) {
    memcpy(out, applied_shape, sizeof(Scalar) * (size_t)(n < MAX_ACT ? n : MAX_ACT));
    return n_transfers;
}

static COMPL_STAT push_error(UInt number, const char *what) {
    pthread_mutex_lock(&si_mutex);
    if (n_errors == STACK) memmove(errors, errors + 1, sizeof *errors * (STACK - 1)), n_errors--;
    errors[n_errors].number = number;
    snprintf(errors[n_errors].text, sizeof errors->text, "%s", what);
    n_errors++;
    pthread_mutex_unlock(&si_mutex);
    return FAILURE;
}

/* Checks at the beginning of every call on a mirror; 1 if the call ends here, with its result in *outcome. */
static int call_rejected(asdkDM *dm, struct si_function *function, struct si_rule *rule,
                         COMPL_STAT *outcome) {
    *rule = si_begin_call(function);
    if (dm < mirrors || dm >= mirrors + MAX_DM || dm->open == 0) {
        si_report_violation("%s: the handle is not that of an open mirror", function->name);
        return *outcome = push_error(0x100, "bad handle"), 1;
    }
    if (dm->open == 2 && strcmp(function->name, "asdkRelease") != 0)
        si_report_violation("%s: asdkInit had failed; the real library may crash here", function->name);
    if (si_unplugged) return *outcome = push_error(0x101, "interface not connected"), 1;
    switch (rule->action) {
    case SI_ERROR: return *outcome = push_error((UInt)rule->argument, "scripted error"), 1;
    case SI_IGNORE: return *outcome = SUCCESS, 1;
    case SI_TIMEOUT:
        si_sleep_until(si_now_ns() + rule->argument * 1000000);
        return *outcome = push_error(0x10D, "acknowledge time-out"), 1;
    case SI_RESET:
        memset(applied_shape, 0, sizeof applied_shape);
        return *outcome = push_error(0x105, "the electronics were reset"), 1;
    default: return 0;
    }
}

/* The end of a call that was executed: its acknowledgement arrives, or is lost. */
static COMPL_STAT end_call(const struct si_rule *rule) {
    if (rule->action != SI_UNACKNOWLEDGED) return SUCCESS;
    return push_error(rule->argument ? (UInt)rule->argument : 0x10D, "acknowledge time-out");
}

#define BEGIN(title, ...)                                                                                     \
    static struct si_function f = {.name = title};                                                            \
    struct si_rule rule;                                                                                      \
    COMPL_STAT outcome;                                                                                       \
    si_log(title __VA_ARGS__);                                                                                \
    if (call_rejected(dm, &f, &rule, &outcome)) return outcome

static int is_playing(asdkDM *dm) {
    if (dm->playing > 0 && si_now_ns() >= dm->played_until) dm->playing = 0;
    return dm->playing != 0;
}

EXPORT asdkDM *asdkInit(const char *serial) {
    static struct si_function f = {.name = "asdkInit"};
    struct si_rule rule = si_begin_call(&f);
    si_log("asdkInit %s", serial ? serial : "NULL");
    if (si_unplugged) return push_error(0x101, "interface not connected"), NULL;
    if (rule.action == SI_ERROR) return push_error((UInt)rule.argument, "scripted error"), NULL;
    asdkDM *dm = NULL;
    for (int k = MAX_DM - 1; k >= 0; k--)
        if (mirrors[k].open == 0) dm = &mirrors[k];
    for (int k = 0; k < MAX_DM; k++)
        if (mirrors[k].open == 1) {
            si_report_violation("asdkInit: the mirror has an owner already");
            return push_error(4, "already loaded"), NULL;
        }
    if (dm == NULL) return push_error(2, "too many mirrors"), NULL;
    if (rule.action == SI_INVALID_HANDLE) {
        dm->open = 2;
        push_error((UInt)rule.argument, "scripted error");
        return dm;
    }
    uint32_t greeting[1] = {0};
    int linked = si_connect_bench(&dm->bench, "mirror", serial ? serial : "", greeting, sizeof greeting);
    if (linked < 0 || (linked == 0 && (serial == NULL || strcmp(serial, configured_serial) != 0)))
        return push_error(0x24, "cannot open the binary configuration of this serial number"), NULL;
    if (linked) n_act = (int)greeting[0];
    dm->open = 1;
    dm->playing = dm->not_at_zero = 0;
    dm->linked = linked;
    parameters[0].value = n_act;
    return dm;
}

EXPORT COMPL_STAT asdkRelease(asdkDM *dm) {
    static struct si_function f = {.name = "asdkRelease"};
    struct si_rule rule;
    COMPL_STAT outcome = SUCCESS;
    si_log("asdkRelease");
    int no = call_rejected(dm, &f, &rule, &outcome);
    if (dm < mirrors || dm >= mirrors + MAX_DM || dm->open == 0) return outcome;
    if (dm->open == 1 && is_playing(dm) && !si_unplugged)
        si_report_violation("asdkRelease: a pattern is being sent; asdkStop first");
    if (dm->open == 1 && dm->not_at_zero && !si_unplugged)
        si_report_violation("asdkRelease: the mirror is not at zero; asdkReset first");
    dm->open = 0;
    si_disconnect_bench(&dm->bench);
    return no ? outcome : SUCCESS;
}

static COMPL_STAT transfer(asdkDM *dm, const Scalar *v) {
    uint32_t size = (uint32_t)(sizeof *v * (size_t)n_act);
    if (dm->linked && si_request(&dm->bench, SI_SEND, v, size, NULL, 0, NULL))
        return push_error(0x101, "the connection to the simulated bench is lost");
    memcpy(applied_shape, v, sizeof *v * (size_t)n_act);
    dm->not_at_zero = 1;
    n_transfers++;
    return SUCCESS;
}

/* 1: within range, 0: rejected, -1: ignored without an error. */
static int check_range(const char *function, const Scalar *v, int n) {
    for (int k = 0; k < n; k++) {
        if (!isfinite(v[k])) {
            si_report_violation("%s: value %d is not finite", function, k);
            return 0;
        }
        if (fabs(v[k]) > 1 && range_mode != ACCEPT) {
            si_report_violation("%s: value %d is %g, out of range", function, k, v[k]);
            return range_mode == REFUSE ? 0 : -1;
        }
    }
    return 1;
}

EXPORT COMPL_STAT asdkSend(asdkDM *dm, const Scalar *v) {
    static struct si_function f = {.name = "asdkSend"};
    struct si_rule rule;
    COMPL_STAT outcome;
    if (si_recording && v) si_log("asdkSend %.17g %.17g .. %.17g", v[0], v[1], v[n_act - 1]);
    if (call_rejected(dm, &f, &rule, &outcome)) return outcome;
    if (v == NULL) return si_report_violation("asdkSend: no values"), push_error(0x100, "missing parameter");
    if (is_playing(dm)) {
        si_report_violation("asdkSend: a pattern is being sent; asdkStop first");
        return push_error(0x106, "asynchronous transfer");
    }
    /* No edge ever comes here: the interface gives up. */
    if (parameter_of("TriggerIn")->value > 0) return push_error(0x10E, "no trigger");
    int range_result = check_range("asdkSend", v, n_act);
    if (range_result == 0) return push_error(0x11, "value out of range");
    if (range_result > 0 && transfer(dm, v) != SUCCESS) return FAILURE;
    return end_call(&rule);
}

EXPORT COMPL_STAT asdkSendPattern(asdkDM *dm, const Scalar *p, UInt n_pattern, UInt n_repeat) {
    BEGIN("asdkSendPattern", " %u %u", n_pattern, n_repeat);
    if (p == NULL || n_pattern == 0) {
        si_report_violation("asdkSendPattern: no values");
        return push_error(0x100, "missing parameter");
    }
    if (is_playing(dm)) {
        si_report_violation("asdkSendPattern: a pattern is being sent; asdkStop first");
        return push_error(0x106, "asynchronous transfer");
    }
    if (check_range("asdkSendPattern", p, n_act * (int)n_pattern) == 0)
        return push_error(0x11, "value out of range");
    if (parameter_of("TriggerIn")->value > 0) {
        if (!trigger_is_set) return push_error(0x102, "time-out of the output");
        trigger_is_set = 0;
    }
    outcome = transfer(dm, p + (size_t)(n_pattern - 1) * (size_t)n_act);
    dm->playing = n_repeat ? (int)n_repeat : -1;
    /* A millisecond each, the order of this mirror's settling time. */
    dm->played_until = si_now_ns() + (int64_t)n_pattern * n_repeat * 1000000;
    return outcome == SUCCESS ? end_call(&rule) : outcome;
}

EXPORT COMPL_STAT asdkStop(asdkDM *dm) {
    BEGIN("asdkStop", "%s", "");
    dm->playing = 0;
    return end_call(&rule);
}

EXPORT COMPL_STAT asdkReset(asdkDM *dm) {
    static const Scalar zeros[MAX_ACT];
    if (dm >= mirrors && dm < mirrors + MAX_DM) dm->not_at_zero = 0; /* requested, even if it fails now */
    BEGIN("asdkReset", "%s", "");
    if (is_playing(dm)) si_report_violation("asdkReset: a pattern is being sent; asdkStop first");
    if (dm->linked && transfer(dm, zeros) != SUCCESS) return FAILURE;
    memset(applied_shape, 0, sizeof applied_shape);
    dm->not_at_zero = 0;
    return end_call(&rule);
}

EXPORT COMPL_STAT asdkGet(asdkDM *dm, const char *name, Scalar *out) {
    BEGIN("asdkGet", " %s", name ? name : "NULL");
    struct parameter *p = parameter_of(name);
    if (p == NULL) return push_error(0x10, "unknown command name");
    if (!p->gets) return push_error(0x10A, "not supported");
    if (out == NULL)
        return si_report_violation("asdkGet: null pointer"), push_error(0x100, "missing parameter");
    *out = p->value;
    return SUCCESS;
}

EXPORT COMPL_STAT asdkSet(asdkDM *dm, const char *name, Scalar value) {
    BEGIN("asdkSet", " %s %g", name ? name : "NULL", value);
    struct parameter *p = parameter_of(name);
    if (p == NULL) return push_error(0x10, "unknown command name");
    if (!p->sets) return push_error(0x10A, "not supported");
    int is_trigger = strcmp(p->name, "TriggerIn") == 0;
    if (is_trigger && !has_triggers) return push_error(0x10A, "not supported");
    if (!(value >= p->low && value <= p->high)) {
        si_report_violation("asdkSet: %s = %g, out of range", p->name, value);
        return push_error(0x11, "value out of range");
    }
    p->value = value;
    if (is_trigger) trigger_is_set = 1;
    return SUCCESS;
}

EXPORT COMPL_STAT asdkSetString(asdkDM *dm, const char *name, const char *value) {
    BEGIN("asdkSetString", " %s %s", name ? name : "NULL", value ? value : "NULL");
    return name && strcasecmp(name, "CfgPath") == 0 ? SUCCESS : push_error(0x10, "unknown command name");
}

EXPORT COMPL_STAT asdkSetVector(asdkDM *dm, const char *name, Scalar *v, Int n) {
    BEGIN("asdkSetVector", " %s %d", name ? name : "NULL", n);
    if (v == NULL || n < 1) return push_error(0x100, "missing parameter");
    return name && strcasecmp(name, "mcff") == 0 ? SUCCESS : push_error(0x10, "unknown command name");
}

/* Public programs disagree whether reading an error removes it from the stack. Here it is removed when its
 * text is fetched or, with 'set errors_stay 1', not at all: a driver must work with both. */
EXPORT COMPL_STAT asdkGetLastError(UInt *number, char *text, size_t size) {
    COMPL_STAT outcome = FAILURE;
    pthread_mutex_lock(&si_mutex);
    if (n_errors > 0) {
        if (number) *number = errors[n_errors - 1].number;
        if (text && size) snprintf(text, size, "%s", errors[n_errors - 1].text);
        if (text && size && !errors_stay) n_errors--;
        outcome = SUCCESS;
    }
    pthread_mutex_unlock(&si_mutex);
    return outcome;
}

EXPORT void asdkPrintLastError(void) {
    UInt number;
    char text[128];
    if (asdkGetLastError(&number, text, sizeof text) == SUCCESS) fprintf(stderr, "0x%X %s\n", number, text);
}

/* Nanoseconds per asdkSend called from C: the lower limit for any driver. */
EXPORT double escape_stand_in_time(asdkDM *dm, const Scalar *v, long n) {
    int64_t start = si_now_ns();
    for (long k = 0; k < n; k++)
        if (asdkSend(dm, v) != SUCCESS) return NAN;
    return (double)(si_now_ns() - start) / (double)n;
}
