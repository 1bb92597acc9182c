/* Shared by the stand-ins of vendor libraries: fault script, call log, violations, connection to a bench.
 *
 * A stand-in is strict: use that the real library leaves undefined is recorded as a violation. The control
 * functions (escape_stand_in...) are exported beside the vendor's; their presence tells a driver that the
 * device is simulated.
 *
 * Script, one rule per line or separated by ';':
 *     FUNCTION WHEN ACTION [ARGUMENT]     WHEN: N (the N-th call), N.. (from there on), N..M
 *     set KEY VALUE                       a property of the device
 * FUNCTION '*' counts the calls of all functions. Actions: error CODE, ignore, timeout MS, reset,
 * short BYTES, unplug, invalid_handle CODE, drop N; a library supports those that apply to a function.
 */
#ifndef ESCAPE_STAND_IN_H
#define ESCAPE_STAND_IN_H

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default")))
#define SI_RULES 256
#define SI_LOG_BYTES (8u << 20)
#define SI_TIMEOUT_S 60 /* a simulated bench compiles its optics on the first frame */

enum si_action {
    SI_NONE, SI_ERROR, SI_IGNORE, SI_TIMEOUT, SI_RESET, SI_SHORT, SI_UNPLUG, SI_INVALID_HANDLE, SI_DROP,
    SI_UNACKNOWLEDGED
};
static const char *const si_actions[] = {"", "error", "ignore", "timeout", "reset",
                                         "short", "unplug", "invalid_handle", "drop", "unacknowledged"};
/* Words of version 0.1.0 and their present names. */
static const char *const si_renamed[][2] = {
    {"lose", "drop"}, {"half", "invalid_handle"}, {"peeks", "errors_stay"}, {"dim", "attenuation"},
    {"pace", "real_time"}, {"first", "first_frame"}, {"lost_code", "disconnect_code"}, {"step", "increment"},
};

struct si_rule {
    char function[64];
    long first, last;
    enum si_action action;
    long argument;
};

/* One per vendor function, with the number of its calls. */
struct si_function {
    const char *name;
    long calls;
    struct si_function *next;
};

struct si_text {
    char *bytes;
    size_t length;
};

static pthread_mutex_t si_mutex = PTHREAD_MUTEX_INITIALIZER;
static struct si_rule si_rules[SI_RULES];
static int si_n_rules, si_recording, si_unplugged;
static long si_calls;
static struct si_function *si_functions;
static struct si_text si_log_text, si_violations;

/* Supplied by each library: set a property of the device; 0 if the key or value is invalid. */
static int si_set_property(const char *key, const char *value);
/* Supplied by each library: restore the initial state of the device. */
static void si_reset_device(void);

static void si_append(struct si_text *text, const char *mark, const char *format, va_list arguments) {
    if (text->bytes == NULL && (text->bytes = malloc(SI_LOG_BYTES)) == NULL) return;
    size_t room = SI_LOG_BYTES - text->length;
    if (room < 512) return;
    int n = snprintf(text->bytes + text->length, room, "%s", mark);
    n += vsnprintf(text->bytes + text->length + n, room - (size_t)n - 2, format, arguments);
    if ((size_t)n > room - 2) n = (int)(room - 2);
    text->length += (size_t)n;
    text->bytes[text->length++] = '\n';
    text->bytes[text->length] = 0;
}

__attribute__((format(printf, 1, 2))) static void si_log(const char *format, ...) {
    if (!si_recording) return;
    va_list arguments;
    va_start(arguments, format);
    pthread_mutex_lock(&si_mutex);
    si_append(&si_log_text, "", format, arguments);
    pthread_mutex_unlock(&si_mutex);
    va_end(arguments);
}

__attribute__((format(printf, 1, 2))) static void si_report_violation(const char *format, ...) {
    va_list arguments, again;
    va_start(arguments, format);
    va_copy(again, arguments);
    pthread_mutex_lock(&si_mutex);
    si_append(&si_violations, "", format, arguments);
    if (si_recording) si_append(&si_log_text, "! ", format, again);
    pthread_mutex_unlock(&si_mutex);
    va_end(again);
    va_end(arguments);
}

/* Count a call; returns the rule that applies to it (action SI_NONE without one). */
static struct si_rule si_begin_call(struct si_function *function) {
    struct si_rule found = {.action = SI_NONE};
    pthread_mutex_lock(&si_mutex);
    if (function->calls++ == 0) {
        function->next = si_functions;
        si_functions = function;
    }
    si_calls++;
    for (int k = 0; k < si_n_rules; k++) {
        const struct si_rule *rule = &si_rules[k];
        int any = strcmp(rule->function, "*") == 0;
        if (!any && strcmp(rule->function, function->name) != 0) continue;
        long number = any ? si_calls : function->calls;
        if (number < rule->first || number > rule->last) continue;
        found = *rule;
        break;
    }
    if (found.action == SI_UNPLUG) si_unplugged = 1;
    pthread_mutex_unlock(&si_mutex);
    return found;
}

static void si_replace_old_word(char *word, size_t size) {
    for (size_t k = 0; k < sizeof si_renamed / sizeof *si_renamed; k++) {
        const char *const *pair = si_renamed[k];
        if (strcmp(word, pair[0]) != 0) continue;
        fprintf(stderr, "deprecated: '%s' is now '%s'; the old word will be removed\n", word, pair[1]);
        snprintf(word, size, "%s", pair[1]);
        return;
    }
}

static int si_parse_rule(const char *line) {
    char function[64], when[32], action[32], argument[64] = "";
    int n = sscanf(line, " %63s %31s %31s %63s", function, when, action, argument);
    if (n <= 0 || function[0] == '#') return 1;
    if (strcmp(function, "set") == 0) {
        si_replace_old_word(when, sizeof when);
        return n == 3 && si_set_property(when, action);
    }
    si_replace_old_word(action, sizeof action);
    if (n < 3 || si_n_rules == SI_RULES) return 0;
    struct si_rule rule = {.action = SI_NONE};
    snprintf(rule.function, sizeof rule.function, "%s", function);
    for (int k = 1; k < (int)(sizeof si_actions / sizeof *si_actions); k++)
        if (strcmp(action, si_actions[k]) == 0) rule.action = (enum si_action)k;
    char *rest;
    rule.first = rule.last = strtol(when, &rest, 10);
    if (strncmp(rest, "..", 2) == 0) {
        rest += 2;
        rule.last = *rest ? strtol(rest, &rest, 10) : LONG_MAX;
    }
    if (*rest || rule.first < 1 || rule.action == SI_NONE) return 0;
    rule.argument = strtol(argument, &rest, 0);
    if (*rest) return 0;
    si_rules[si_n_rules++] = rule;
    return 1;
}

/* Description of the stand-in; the presence of this function marks a simulated device. */
EXPORT const char *escape_stand_in(void);

/* Add rules; returns 0, or the number of the first invalid line (those before it are in force). */
EXPORT int escape_stand_in_script(const char *text) {
    char line[256];
    int number = 1;
    while (*text) {
        size_t length = strcspn(text, "\n;");
        snprintf(line, sizeof line, "%.*s", (int)length, text);
        pthread_mutex_lock(&si_mutex);
        int good = si_parse_rule(line);
        pthread_mutex_unlock(&si_mutex);
        if (!good) return number;
        text += length + (text[length] != 0);
        number++;
    }
    return 0;
}

/* Clear calls, script and violations, and restore the device's initial state. */
EXPORT void escape_stand_in_clear(void) {
    pthread_mutex_lock(&si_mutex);
    si_n_rules = si_unplugged = si_recording = 0;
    si_calls = 0;
    si_log_text.length = si_violations.length = 0;
    for (struct si_function *f = si_functions; f; f = f->next) f->calls = 0;
    si_functions = NULL;
    si_reset_device();
    pthread_mutex_unlock(&si_mutex);
    const char *script = getenv("ESCAPE_STAND_IN_SCRIPT");
    if (script != NULL && escape_stand_in_script(script) != 0) {
        fprintf(stderr, "ESCAPE_STAND_IN_SCRIPT: invalid line in: %s\n", script);
        exit(2);
    }
}

EXPORT void escape_stand_in_record(int on) { si_recording = on; }
EXPORT long escape_stand_in_calls(void) { return si_calls; }

/* Copy the log (which 0) or the violations (which 1); returns the length of the whole text. */
EXPORT size_t escape_stand_in_text(int which, char *out, size_t size) {
    pthread_mutex_lock(&si_mutex);
    const struct si_text *text = which ? &si_violations : &si_log_text;
    size_t length = text->length;
    if (out != NULL && size > 0) {
        size_t n = length < size - 1 ? length : size - 1;
        if (n) memcpy(out, text->bytes, n);
        out[n] = 0;
    }
    pthread_mutex_unlock(&si_mutex);
    return length;
}

__attribute__((constructor)) static void si_on_load(void) { escape_stand_in_clear(); }

static int64_t si_now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void si_sleep_until(int64_t ns) {
    struct timespec t = {.tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) continue;
}

/* ---- connection to a simulated bench: a local socket, one request and one reply at a time ------------ */
enum si_request_kind { SI_HELLO = 1, SI_SEND, SI_START, SI_FRAME, SI_STOP };

struct si_connection {
    int fd;
};

/* Send (out) or receive all bytes; 0 when the connection is lost. */
static int si_transfer(int fd, void *bytes, size_t length, int out) {
    char *at = bytes;
    while (length) {
        ssize_t n = out ? send(fd, at, length, MSG_NOSIGNAL) : recv(fd, at, length, 0);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return 0;
        at += n;
        length -= (size_t)n;
    }
    return 1;
}

/* Send a request; returns its status (0 success, 1 time-out, 2 refused), or -1 when the connection is lost.
 * Up to size bytes of the reply are copied to out; *got is their number. */
static int si_request(struct si_connection *connection, uint32_t kind, const void *payload, uint32_t length,
                      void *out, uint32_t size, uint32_t *got) {
    uint32_t head[2] = {kind, length};
    int32_t reply[2];
    if (connection->fd < 0) return -1;
    int fd = connection->fd;
    if (!si_transfer(fd, head, sizeof head, 1) || !si_transfer(fd, (void *)payload, length, 1) ||
        !si_transfer(fd, reply, sizeof reply, 0) || (uint32_t)reply[1] > size ||
        !si_transfer(connection->fd, out, (uint32_t)reply[1], 0)) {
        close(connection->fd);
        connection->fd = -1;
        return -1;
    }
    if (got) *got = (uint32_t)reply[1];
    return reply[0];
}

static void si_disconnect_bench(struct si_connection *connection) {
    if (connection->fd >= 0) close(connection->fd);
    connection->fd = -1;
}

/* Connect to the bench of ESCAPE_STAND_IN_BENCH as the device of this kind and serial number.
 * 0: no bench is configured; 1: connected, its greeting is in out; -1: refused or not there. */
static int si_connect_bench(struct si_connection *connection, const char *kind, const char *serial, void *out,
                         uint32_t size) {
    connection->fd = -1;
    const char *path = getenv("ESCAPE_STAND_IN_BENCH");
    if (path == NULL || *path == 0) return 0;
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    snprintf(address.sun_path, sizeof address.sun_path, "%s", path);
    connection->fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (connection->fd < 0) return -1;
    /* A bench that hangs must not block a driver for ever. */
    struct timeval timeout = {.tv_sec = SI_TIMEOUT_S};
    setsockopt(connection->fd, SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout);
    setsockopt(connection->fd, SOL_SOCKET, SO_SNDTIMEO, &timeout, sizeof timeout);
    char greeting[160];
    int n = snprintf(greeting, sizeof greeting, "%s %s", kind, serial);
    if (connect(connection->fd, (struct sockaddr *)&address, sizeof address) != 0 ||
        si_request(connection, SI_HELLO, greeting, (uint32_t)n, out, size, NULL) != 0) {
        si_disconnect_bench(connection);
        return -1;
    }
    return 1;
}

#endif
