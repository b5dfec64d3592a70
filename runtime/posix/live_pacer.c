#include "live_pacer.h"

#include <string.h>

#define SLEEP_AT_MOST_NS 20000000u   /* to see *stop */
#define NS_PER_1000_S 1000000000000u /* a turn at one millihertz */

uint64_t live_pacer_due_ns(const live_pacer *pacer, uint64_t column) {
    const uint64_t columns = pacer->config->columns;
    const uint64_t rate = pacer->config->rate_millihertz;
    const uint64_t turns = column / columns;
    const uint64_t rest = column % columns;

    /* From whole turns and a rest: the product over all columns would overflow after an hour, and a sum drift. */
    return pacer->config->lead_ns + turns * NS_PER_1000_S / rate + rest * NS_PER_1000_S / (rate * columns);
}

static uint64_t played_packets(const live_pacer *pacer) {
    return atomic_load_explicit(&pacer->shown_packets, memory_order_relaxed);
}

/* The arrays' last column is followed by their first one again. */
static void wrap_columns(live_pacer *pacer, live_packet *packet, uint64_t at, uint64_t before_end) {
    const upb_live_config *config = pacer->config;
    const size_t head = (size_t)before_end * UPB_BEAMS;
    const size_t tail = (size_t)(packet->columns - before_end) * UPB_BEAMS;

    memcpy(pacer->wrapped_distance, config->distance + at * UPB_BEAMS, head * sizeof *config->distance);
    memcpy(pacer->wrapped_distance + head, config->distance, tail * sizeof *config->distance);
    memcpy(pacer->wrapped_intensity, config->intensity + at * UPB_BEAMS, head);
    memcpy(pacer->wrapped_intensity + head, config->intensity, tail);
    packet->distance = pacer->wrapped_distance;
    packet->intensity = pacer->wrapped_intensity;
}

int live_pacer_next(live_pacer *pacer, live_packet *packet) {
    const upb_live_config *config = pacer->config;
    const uint64_t in_arrays = (uint64_t)config->frames * config->columns;
    const uint64_t at = pacer->next_column % in_arrays;
    const uint64_t left = pacer->columns_total - pacer->next_column;

    if (left == 0)
        return 0;
    packet->sequence = played_packets(pacer);
    packet->first_column = pacer->next_column;
    packet->received_ns = 0;
    packet->columns = left < config->columns_per_packet ? (uint32_t)left : config->columns_per_packet;
    packet->distance = config->distance + at * UPB_BEAMS;
    packet->intensity = config->intensity + at * UPB_BEAMS;
    if (packet->columns > in_arrays - at)
        wrap_columns(pacer, packet, at, in_arrays - at);
    pacer->next_column += packet->columns;
    return 1;
}

static void note_drop(live_pacer *pacer, const live_packet *packet, upb_live_cause cause) {
    atomic_fetch_add_explicit(&pacer->shown_dropped, 1, memory_order_relaxed);
    if (pacer->drop_count == pacer->drop_capacity) {
        pacer->drops_unlisted++;
        return;
    }
    pacer->drops[pacer->drop_count++] = (upb_live_drop){
        .packet = packet->sequence, .at_ns = packet->received_ns, .columns = packet->columns, .cause = (uint32_t)cause};
}

int live_pacer_drops(live_pacer *pacer, const live_packet *packet) {
    const upb_live_config *config = pacer->config;

    while (pacer->drop_next < config->drop_count && config->drop_packets[pacer->drop_next] < packet->sequence)
        pacer->drop_next++;
    if (pacer->drop_next == config->drop_count || config->drop_packets[pacer->drop_next] != packet->sequence)
        return 0;
    pacer->dropped_fault++;
    note_drop(pacer, packet, UPB_LIVE_CAUSE_FAULT);
    return 1;
}

void live_pacer_overflowed(live_pacer *pacer, const live_packet *packet) {
    pacer->dropped_overflow++;
    note_drop(pacer, packet, UPB_LIVE_CAUSE_OVERFLOW);
}

void live_pacer_played(live_pacer *pacer, const live_packet *packet) {
    pacer->columns_played += packet->columns;
    atomic_fetch_add_explicit(&pacer->shown_packets, 1, memory_order_relaxed);
}

void live_pacer_wait(const live_pacer *pacer, uint64_t due_ns, _Atomic int *stop) {
    const uint64_t spin_ns = pacer->config->spin_ns;
    const uint64_t sleep_until = due_ns > spin_ns ? due_ns - spin_ns : 0;

    for (;;) {
        const uint64_t now = live_clock_now(pacer->clock);
        if (now >= sleep_until || atomic_load_explicit(stop, memory_order_relaxed))
            break;
        live_clock_sleep(pacer->clock, sleep_until - now > SLEEP_AT_MOST_NS ? now + SLEEP_AT_MOST_NS : sleep_until);
    }
    while (live_clock_now(pacer->clock) < due_ns && !atomic_load_explicit(stop, memory_order_relaxed)) {
    }
}
