#include "settings.h"

#include <ctype.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

typedef enum setting_kind { NUMBER, SIGNED, MILLISECONDS, TEXT, NAME, ADDRESS, SABOTAGE } setting_kind;

typedef struct setting {
    const char *key;
    setting_kind kind;
    size_t offset;
    const char *meaning;
    const char *names; /* NAME: "value0 value1 ...", value i is `first` + i */
    uint32_t first;
} setting;

#define OF(field) offsetof(settings, field)

static const setting table[] = {
    {"config", TEXT, OF(config), "file of settings, read before the other flags", NULL, 0},
    {"model", TEXT, OF(model), "model file (.ubm); read again on SIGHUP", NULL, 0},
    {"models", TEXT, OF(models), "folder of model files that a command may ask for by checksum", NULL, 0},
    {"sensor", NAME, OF(daemon.sensor), "the sensor", "hdl-32e vlp-32c", UPB_SENSOR_HDL_32E},
    {"any_model", NUMBER, OF(daemon.any_model), "1: take a model made for another sensor", NULL, 0},
    {"listen", TEXT, OF(listen), "address:port of the sensor's data packets", NULL, 0},
    {"position_listen", TEXT, OF(position_listen), "address:port of its position packets; empty: none", NULL, 0},
    {"source", ADDRESS, OF(daemon.source_ipv4), "take packets from this address only; 0.0.0.0: from any", NULL, 0},
    {"rpm", NUMBER, OF(daemon.rpm), "nominal turns a minute; 0: as measured when the stream begins", NULL, 0},
    {"rpm_tolerance_permille", NUMBER, OF(daemon.rpm_tolerance_permille), "of rpm, then SENSOR_RPM_RANGE", NULL, 0},
    {"cut_mdeg", NUMBER, OF(daemon.cut_mdeg), "azimuth where frames begin; 4294967295: the model's", NULL, 0},
    {"fov_begin_mdeg", NUMBER, OF(daemon.fov_begin_mdeg), "a sensor that fires in a part of the turn: from here", NULL,
     0},
    {"fov_end_mdeg", NUMBER, OF(daemon.fov_end_mdeg), "clockwise to here; equal: the whole turn", NULL, 0},
    {"width_tolerance_permille", NUMBER, OF(daemon.width_tolerance_permille),
     "change of speed at which the stream is made anew", NULL, 0},
    {"precision", NAME, OF(daemon.precision), "of the networks", "fp32 int16 int8", 0},
    {"cpu", NAME, OF(daemon.cpu), "instruction set", "auto scalar avx2 avx512 neon avx512-vnni neon-dot", 0},
    {"columns", TEXT, OF(columns), "address:port the column stream goes to; empty: none", NULL, 0},
    {"hdl64", TEXT, OF(hdl64), "address:port the HDL-64E packets go to; empty: none", NULL, 0},
    {"calibration", TEXT, OF(calibration), "file to write for drivers: the HDL-64E's table; empty: none", NULL, 0},
    {"can", TEXT, OF(can), "udp:PORT:ADDRESS:PORT or socketcan:NAME; empty: none", NULL, 0},
    {"serial", TEXT, OF(serial), "tty of the console; empty: none", NULL, 0},
    {"serial_baud", NUMBER, OF(serial_baud), "9600, 115200, 230400, 460800 or 921600", NULL, 0},
    {"key", TEXT, OF(key), "file of the key for commands, 32 hexadecimal digits; empty: no command is taken", NULL, 0},
    {"state", TEXT, OF(state), "folder of fault memory and freshness counter; empty: neither is kept", NULL, 0},
    {"json", TEXT, OF(json), "status file (JSON), written every json_ms and at the end; empty: none", NULL, 0},
    {"json_ms", NUMBER, OF(json_ms), "between two writes of it", NULL, 0},
    {"ledger", TEXT, OF(ledger), "file of ledger records and events, a JSON object a line; empty: none", NULL, 0},
    {"deadline_ms", MILLISECONDS, OF(daemon.deadline_ns), "latency of a frame above which it is missed", NULL, 0},
    {"ladder_mean_ms", MILLISECONDS, OF(daemon.ladder_down_ns[0]), "lag from which rows are valid means", NULL, 0},
    {"ladder_repeat_ms", MILLISECONDS, OF(daemon.ladder_down_ns[1]), "lag from which rows are repeated", NULL, 0},
    {"ladder_pass_ms", MILLISECONDS, OF(daemon.ladder_down_ns[2]), "lag from which no row is generated", NULL, 0},
    {"ladder_up_ms", MILLISECONDS, OF(daemon.ladder_up_ns), "lag below which a rung is climbed again", NULL, 0},
    {"ladder_hold_ms", MILLISECONDS, OF(daemon.ladder_hold_ns), "and for so long", NULL, 0},
    {"mode_floor", NAME, OF(daemon.mode_floor), "never a better mode", "network valid_mean repeat pass_through", 0},
    {"stale_ms", MILLISECONDS, OF(daemon.stale_ns), "a packet that waited longer is dropped", NULL, 0},
    {"timeout_ms", MILLISECONDS, OF(daemon.timeout_ns), "silence of the sensor, then SENSOR_TIMEOUT", NULL, 0},
    {"flood_per_second", NUMBER, OF(daemon.flood_per_second),
     "refused packets, then NET_FLOOD; 0: 1.25 times what the sensor sends", NULL, 0},
    {"jitter_ms", MILLISECONDS, OF(daemon.jitter_ns), "arrival against sensor time, then NET_JITTER", NULL, 0},
    {"drift_ppm", NUMBER, OF(daemon.drift_ppm), "sensor clock against ours, then CLOCK_DRIFT", NULL, 0},
    {"loss_permille", NUMBER, OF(daemon.loss_permille), "firings of a frame that never came, then NET_LOSS", NULL, 0},
    {"throttle_permille", NUMBER, OF(daemon.throttle_permille), "work against its baseline, then COMPUTE_THROTTLE",
     NULL, 0},
    {"visibility_permille", NUMBER, OF(daemon.visibility_permille),
     "returns against their baseline, then SENSOR_VISIBILITY", NULL, 0},
    {"crosstalk_permille", NUMBER, OF(daemon.crosstalk_permille), "returns that stand alone, then SENSOR_CROSSTALK",
     NULL, 0},
    {"integrity_bytes", NUMBER, OF(daemon.integrity_bytes), "of constant memory checked after each frame", NULL, 0},
    {"ubm_bytes_max", NUMBER, OF(daemon.ubm_bytes_max), "largest model file", NULL, 0},
    {"ledger_capacity", NUMBER, OF(daemon.ledger_capacity), "closed frames kept in memory", NULL, 0},
    {"receive_buffer", NUMBER, OF(receive_buffer), "bytes of socket buffer to ask for", NULL, 0},
    {"ring_packets", NUMBER, OF(ring_packets), "datagrams between receiving and work, a power of two", NULL, 0},
    {"priority", NUMBER, OF(priority), "SCHED_FIFO priority of both threads, 1..99; 0: none", NULL, 0},
    {"receive_cpu", SIGNED, OF(receive_cpu), "core of the receiving thread; -1: any", NULL, 0},
    {"work_cpu", SIGNED, OF(work_cpu), "core of the working thread; -1: any", NULL, 0},
    {"sabotage", SABOTAGE, OF(daemon.sabotage), "tests only: detections and reactions to take out, by name", NULL, 0},
};

enum { SETTINGS = sizeof table / sizeof table[0] };

settings settings_default(void) {
    settings s;
    memset(&s, 0, sizeof s);
    s.daemon = upb_daemon_config_default();
    strcpy(s.listen, "0.0.0.0:2368");
    strcpy(s.position_listen, "0.0.0.0:8308");
    s.json_ms = 1000;
    s.serial_baud = 115200;
    s.receive_buffer = 4u << 20;
    s.ring_packets = 1024;
    s.receive_cpu = s.work_cpu = -1;
    return s;
}

/* ----------------------------------------------------------------------------------------------- values */

static int parse_number(const char *text, long long least, long long most, long long *value) {
    char *end;
    errno = 0;
    *value = strtoll(text, &end, 0);
    return errno == 0 && end != text && *end == '\0' && *value >= least && *value <= most;
}

static int parse_milliseconds(const char *text, uint64_t *ns) {
    char *end;
    errno = 0;
    const double ms = strtod(text, &end);
    if (errno != 0 || end == text || *end != '\0' || !(ms >= 0.0) || ms > 3.6e6)
        return 0;
    *ns = (uint64_t)(ms * 1e6 + 0.5);
    return 1;
}

static int parse_address(const char *text, uint32_t *address) {
    unsigned part[4];
    char rest;
    if (sscanf(text, "%3u.%3u.%3u.%3u%c", &part[0], &part[1], &part[2], &part[3], &rest) != 4)
        return 0;
    for (int i = 0; i < 4; i++)
        if (part[i] > 255)
            return 0;
    *address = part[0] << 24 | part[1] << 16 | part[2] << 8 | part[3];
    return 1;
}

/* Words of `names` are separated by one blank. -1: not among them. */
static int word_index(const char *names, const char *word) {
    const size_t bytes = strlen(word);
    int index = 0;
    for (const char *at = names; bytes; index++) {
        const char *end = strchr(at, ' ');
        const size_t here = end ? (size_t)(end - at) : strlen(at);
        if (here == bytes && memcmp(at, word, bytes) == 0)
            return index;
        if (!end)
            break;
        at = end + 1;
    }
    return -1;
}

static int parse_sabotage(const char *text, uint64_t *mask) {
    char copy[SETTING_TEXT];
    *mask = 0;
    if (strlen(text) >= sizeof copy)
        return 0;
    strcpy(copy, text);
    char *rest = NULL;
    for (char *word = strtok_r(copy, " ,", &rest); word; word = strtok_r(NULL, " ,", &rest)) {
        uint32_t bit = 0;
        while (upb_daemon_check_name(bit) && strcmp(upb_daemon_check_name(bit), word) != 0)
            bit++;
        if (!upb_daemon_check_name(bit))
            return 0;
        *mask |= UINT64_C(1) << bit;
    }
    return 1;
}

static const setting *find(const char *key) {
    for (size_t i = 0; i < SETTINGS; i++) {
        const char *a = table[i].key, *b = key;
        while (*a && (*a == *b || (*a == '_' && *b == '-'))) {
            a++;
            b++;
        }
        if (!*a && !*b)
            return &table[i];
    }
    return NULL;
}

static int store(settings *s, const setting *entry, const char *value) {
    char *const at = (char *)s + entry->offset;
    long long number;
    uint64_t wide;
    uint32_t narrow;
    int32_t with_sign;
    switch (entry->kind) {
    case NUMBER:
        if (!parse_number(value, 0, UINT32_MAX, &number))
            return 0;
        narrow = (uint32_t)number;
        memcpy(at, &narrow, sizeof narrow);
        return 1;
    case SIGNED:
        if (!parse_number(value, -1, 4095, &number))
            return 0;
        with_sign = (int32_t)number;
        memcpy(at, &with_sign, sizeof with_sign);
        return 1;
    case NAME:
        number = word_index(entry->names, value);
        if (number < 0)
            return 0;
        narrow = entry->first + (uint32_t)number;
        memcpy(at, &narrow, sizeof narrow);
        return 1;
    case ADDRESS:
        if (!parse_address(value, &narrow))
            return 0;
        memcpy(at, &narrow, sizeof narrow);
        return 1;
    case MILLISECONDS:
        if (!parse_milliseconds(value, &wide))
            return 0;
        memcpy(at, &wide, sizeof wide);
        return 1;
    case SABOTAGE:
        if (!parse_sabotage(value, &wide))
            return 0;
        memcpy(at, &wide, sizeof wide);
        return 1;
    default:
        if (strlen(value) >= SETTING_TEXT)
            return 0;
        strcpy(at, value);
        return 1;
    }
}

static const char *expected(const setting *entry) {
    switch (entry->kind) {
    case NUMBER:
        return "a whole number, 0 to 4294967295";
    case SIGNED:
        return "a whole number, -1 to 4095";
    case MILLISECONDS:
        return "milliseconds, 0 to 3600000";
    case ADDRESS:
        return "an IPv4 address";
    case SABOTAGE:
        return "names of detections and reactions";
    case NAME:
        return entry->names;
    default:
        return "at most 255 characters";
    }
}

int settings_set(settings *s, const char *key, const char *value, char *problem, size_t problem_bytes) {
    const setting *entry = find(key);
    if (!entry) {
        snprintf(problem, problem_bytes, "unknown setting '%s'", key);
        return 0;
    }
    if (!store(s, entry, value)) {
        snprintf(problem, problem_bytes, "%s is '%s', expected %s", entry->key, value, expected(entry));
        return 0;
    }
    return 1;
}

/* ------------------------------------------------------------------------------------------------ files */

static char *trimmed(char *text) {
    while (isspace((unsigned char)*text))
        text++;
    size_t bytes = strlen(text);
    while (bytes && isspace((unsigned char)text[bytes - 1]))
        text[--bytes] = '\0';
    return text;
}

static int read_line(settings *s, char *line, char *problem, size_t problem_bytes) {
    char *comment = strchr(line, '#');
    if (comment)
        *comment = '\0';
    char *const text = trimmed(line);
    if (!*text)
        return 1;
    char *const equals = strchr(text, '=');
    if (!equals) {
        snprintf(problem, problem_bytes, "'%s' is no setting, expected key = value", text);
        return 0;
    }
    *equals = '\0';
    return settings_set(s, trimmed(text), trimmed(equals + 1), problem, problem_bytes);
}

int settings_read(settings *s, const char *name, const char *text, char *problem, size_t problem_bytes) {
    char line[2 * SETTING_TEXT], reason[2 * SETTING_TEXT];
    for (unsigned number = 1; *text; number++) {
        const size_t bytes = strcspn(text, "\n");
        if (bytes >= sizeof line) {
            snprintf(problem, problem_bytes, "%s:%u: longer than %zu characters", name, number, sizeof line - 1);
            return 0;
        }
        memcpy(line, text, bytes);
        line[bytes] = '\0';
        text += bytes + (text[bytes] == '\n');
        if (!read_line(s, line, reason, sizeof reason)) {
            snprintf(problem, problem_bytes, "%s:%u: %s", name, number, reason);
            return 0;
        }
    }
    return 1;
}

/* -------------------------------------------------------------------------------------------- printing */

static void print_word(FILE *to, const char *names, uint32_t index) {
    while (index-- && strchr(names, ' '))
        names = strchr(names, ' ') + 1;
    fprintf(to, "%.*s", (int)strcspn(names, " "), names);
}

static void print_value(const settings *s, const setting *entry, FILE *to) {
    const char *const at = (const char *)s + entry->offset;
    uint32_t narrow = 0;
    uint64_t wide = 0;
    if (entry->kind == TEXT) {
        fputs(at, to);
        return;
    }
    if (entry->kind == MILLISECONDS || entry->kind == SABOTAGE)
        memcpy(&wide, at, sizeof wide);
    else
        memcpy(&narrow, at, sizeof narrow);
    if (entry->kind == MILLISECONDS)
        fprintf(to, "%.6g", (double)wide / 1e6);
    else if (entry->kind == SIGNED)
        fprintf(to, "%d", (int)(int32_t)narrow);
    else if (entry->kind == NAME)
        print_word(to, entry->names, narrow - entry->first);
    else if (entry->kind == ADDRESS)
        fprintf(to, "%u.%u.%u.%u", narrow >> 24, narrow >> 16 & 255, narrow >> 8 & 255, narrow & 255);
    else if (entry->kind == NUMBER)
        fprintf(to, "%u", narrow);
    for (uint32_t bit = 0; entry->kind == SABOTAGE && upb_daemon_check_name(bit); bit++)
        if (wide >> bit & 1)
            fprintf(to, "%s ", upb_daemon_check_name(bit));
}

void settings_print(const settings *s, FILE *to) {
    for (size_t i = 0; i < SETTINGS; i++) {
        if (strcmp(table[i].key, "config") == 0)
            continue;
        fprintf(to, "%s = ", table[i].key);
        print_value(s, &table[i], to);
        fputc('\n', to);
    }
}

void settings_print_help(FILE *to) {
    const settings s = settings_default();
    for (size_t i = 0; i < SETTINGS; i++) {
        fprintf(to, "  --%-26s %s", table[i].key, table[i].meaning);
        if (table[i].kind == NAME)
            fprintf(to, ": %s", table[i].names);
        fputs(" [", to);
        print_value(&s, &table[i], to);
        fputs("]\n", to);
    }
}
