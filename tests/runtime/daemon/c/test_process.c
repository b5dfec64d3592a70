/* Parts of upbeamd: the ring between two threads, the settings. Option: --count N (datagrams through the ring). */
#include <pthread.h>
#include <sched.h>

#include "check.h"
#include "packet_ring.h"
#include "settings.h"

/* ------------------------------------------------------------------------------------------------- ring */

enum { SLOTS = 16 };

typedef struct ring_run {
    packet_ring ring;
    ring_datagram slots[SLOTS];
    unsigned long count;
} ring_run;

static void *produce(void *user) {
    ring_run *run = user;
    for (unsigned long i = 0; i < run->count; i++) {
        ring_datagram *slot = packet_ring_claim(&run->ring);
        if (!slot) {
            packet_ring_count_full(&run->ring);
            sched_yield();
            continue;
        }
        slot->received_ns = i;
        slot->bytes = (uint16_t)(i % RING_DATAGRAM_MAX);
        memset(slot->data, (int)(i & 255), slot->bytes);
        packet_ring_publish(&run->ring);
    }
    return NULL;
}

static void test_ring(unsigned long count) {
    static ring_run run;
    pthread_t producer;
    unsigned long taken = 0, full = 0;
    uint64_t last = 0;
    packet_ring_init(&run.ring, run.slots, SLOTS);
    run.count = count;
    if (!CHECK(pthread_create(&producer, NULL, produce, &run) == 0))
        return;
    while (taken + full < count) {
        const ring_datagram *slot = packet_ring_peek(&run.ring);
        full += (unsigned long)packet_ring_take_full(&run.ring);
        if (!slot) {
            sched_yield();
            continue;
        }
        int good = slot->bytes == slot->received_ns % RING_DATAGRAM_MAX && (taken == 0 || slot->received_ns > last);
        for (unsigned i = 0; i < slot->bytes; i++)
            good &= slot->data[i] == (uint8_t)slot->received_ns;
        CHECK(good);
        last = slot->received_ns;
        taken++;
        packet_ring_release(&run.ring);
    }
    pthread_join(producer, NULL);
    CHECK(packet_ring_peek(&run.ring) == NULL);
    CHECK_EQUAL(taken + full, count);
    printf("ring: %lu datagrams, %lu found it full\n", taken, full);
}

/* --------------------------------------------------------------------------------------------- settings */

static void expect_problem(const char *text, const char *problem) {
    settings s = settings_default();
    char got[1024] = "";
    CHECK(!settings_read(&s, "test.conf", text, got, sizeof got));
    if (!CHECK(strcmp(got, problem) == 0))
        fprintf(stderr, "    got '%s'\n", got);
}

static void test_settings(void) {
    settings s = settings_default();
    char problem[1024] = "";
    CHECK(settings_read(&s, "test.conf",
                        "# a comment\n\n model = /tmp/a b.ubm  # and another\r\nsensor=vlp-32c\n"
                        "deadline_ms = 12.5\nmode_floor = repeat\nsource = 192.168.1.201\nwork-cpu = -1\n"
                        "sabotage = net_loss, react_gap\nrpm = 600",
                        problem, sizeof problem));
    CHECK(strcmp(s.model, "/tmp/a b.ubm") == 0);
    CHECK_EQUAL(s.daemon.sensor, UPB_SENSOR_VLP_32C);
    CHECK_EQUAL(s.daemon.deadline_ns, 12500000);
    CHECK_EQUAL(s.daemon.mode_floor, UPB_MODE_REPEAT);
    CHECK_EQUAL(s.daemon.source_ipv4, 0xc0a801c9);
    CHECK_EQUAL(s.daemon.rpm, 600);
    CHECK_EQUAL(s.daemon.sabotage >> (UPB_FAULT_NET_LOSS - 1) & 1, 1);
    expect_problem("model = a\nmodell = b\n", "test.conf:2: unknown setting 'modell'");
    expect_problem("\n\nnonsense\n", "test.conf:3: 'nonsense' is no setting, expected key = value");
    expect_problem("sensor = vlp-16", "test.conf:1: sensor is 'vlp-16', expected hdl-32e vlp-32c");
    expect_problem("rpm = 6x", "test.conf:1: rpm is '6x', expected a whole number, 0 to 4294967295");
    expect_problem("rpm =", "test.conf:1: rpm is '', expected a whole number, 0 to 4294967295");
    expect_problem("rpm = -1", "test.conf:1: rpm is '-1', expected a whole number, 0 to 4294967295");
    expect_problem("deadline_ms = nan", "test.conf:1: deadline_ms is 'nan', expected milliseconds, 0 to 3600000");
    expect_problem("source = 1.2.3.256", "test.conf:1: source is '1.2.3.256', expected an IPv4 address");
    expect_problem("sabotage = nothing",
                   "test.conf:1: sabotage is 'nothing', expected names of detections and reactions");
}

/* What is printed gives the same settings when it is read. */
static void test_print(void) {
    settings s = settings_default(), again = settings_default();
    char text[16384] = "", problem[1024] = "";
    CHECK(settings_set(&s, "model", "x.ubm", problem, sizeof problem));
    CHECK(settings_set(&s, "precision", "int8", problem, sizeof problem));
    CHECK(settings_set(&s, "ladder_up_ms", "0.125", problem, sizeof problem));
    FILE *memory = fmemopen(text, sizeof text, "w");
    if (!CHECK(memory != NULL))
        return;
    settings_print(&s, memory);
    fclose(memory);
    CHECK(settings_read(&again, "printed", text, problem, sizeof problem));
    CHECK(memcmp(&s, &again, sizeof s) == 0);
}

/* Lines of noise: refused or taken, no byte read or written beyond. */
static void test_noise(void) {
    random_source random = random_seeded(7);
    static const char letters[] = "model=rpm sensor_ms.0123456789-#\n\t,xX\"";
    for (unsigned i = 0; i < 20000; i++) {
        settings s = settings_default();
        char text[64], problem[64];
        const uint32_t bytes = random_below(&random, sizeof text);
        for (uint32_t k = 0; k < bytes; k++)
            text[k] = letters[random_below(&random, sizeof letters - 1)];
        text[bytes] = '\0';
        if (!settings_read(&s, "noise", text, problem, sizeof problem))
            CHECK(memchr(problem, '\0', sizeof problem) != NULL);
    }
}

int main(int argc, char **argv) {
    test_ring(option_number(argc, argv, "--count", 200000));
    test_settings();
    test_print();
    test_noise();
    return check_report("upbeamd");
}
