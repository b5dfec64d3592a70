/*
 * Memory that must not change is walked piece by piece, a few KiB at each frame's end, and its CRC-32 compared. What is
 * damaged is made anew from a copy; with no good copy left, generated rows end (PASS_THROUGH).
 */
#include <string.h>

#include "daemon_internal.h"
#include "upb_internal.h"

static const uint8_t *region_of(const upb_daemon *d, uint32_t region, size_t *bytes) {
    const model_slot *slot = &d->slot[d->active];
    switch (region) {
    case UPB_REGION_MODEL:
        *bytes = sizeof(upb_model);
        return slot->memory;
    case UPB_REGION_KEPT:
        *bytes = slot->ubm_bytes;
        return slot->ubm;
    case UPB_REGION_CONFIG:
        *bytes = sizeof d->config;
        return (const uint8_t *)&d->config;
    case UPB_REGION_STREAM:
        *bytes = d->stream ? sizeof(uint32_t) : 0; /* of its checksum: the stream itself knows what is constant */
        return d->stream_memory;
    default:
        *bytes = 0;
        return NULL;
    }
}

static uint32_t crc_of(const upb_daemon *d, uint32_t region) {
    size_t bytes;
    const uint8_t *at = region_of(d, region, &bytes);
    return upb_crc32(0, at, bytes);
}

void daemon_integrity_stream_made(upb_daemon *d) {
    if (d->stream)
        upb_stream_checksum(d->stream, &d->integrity.stream_crc);
}

void daemon_integrity_init(upb_daemon *d) {
    integrity *i = &d->integrity;
    memset(i, 0, sizeof *i);
    i->model_crc = crc_of(d, UPB_REGION_MODEL);
    i->kept_crc = crc_of(d, UPB_REGION_KEPT);
    i->config_crc = crc_of(d, UPB_REGION_CONFIG);
    daemon_integrity_stream_made(d);
}

static size_t watched_bytes(const upb_daemon *d) {
    size_t sum = 0;
    for (uint32_t region = 0; region < UPB_REGIONS; region++) {
        size_t bytes;
        region_of(d, region, &bytes);
        sum += bytes;
    }
    return sum;
}

uint32_t daemon_integrity_period(const upb_daemon *d) {
    const size_t step = d->config.integrity_bytes;
    return step ? (uint32_t)((watched_bytes(d) + step - 1) / step) + 1 : 0;
}

/* ---------------------------------------------------------------------------------------------- repair */

static int repair_model(upb_daemon *d) {
    model_slot *slot = &d->slot[d->active];
    daemon_end_segment(d, 1);
    d->counters.resyncs++;
    /* The file has its own checksum, so that a damaged copy is refused. */
    if (upb_model_load(slot->memory, UPB_MODEL_BYTES_MAX, slot->ubm, slot->ubm_bytes, &slot->model, NULL) != UPB_OK)
        return 0;
    return crc_of(d, UPB_REGION_MODEL) == d->integrity.model_crc;
}

static int repair_config(upb_daemon *d) {
    if (upb_crc32(0, &d->config_copy, sizeof d->config_copy) != d->integrity.config_crc)
        return 0;
    memcpy(&d->config, &d->config_copy, sizeof d->config);
    return 1;
}

static int repair(upb_daemon *d, uint32_t region) {
    if (!daemon_reacts(d, REACT_REPAIR))
        return 0;
    if (region == UPB_REGION_MODEL)
        return repair_model(d);
    if (region == UPB_REGION_CONFIG)
        return repair_config(d);
    if (region == UPB_REGION_STREAM) {
        daemon_drop_segment(d); /* not flushed: what it would do is unknown */
        return 1;
    }
    /* The kept file can only come from outside; the tables in use are still good. */
    return 0;
}

static void found(upb_daemon *d, uint32_t region) {
    d->counters.integrity_failures++;
    if (!daemon_detects(d, UPB_FAULT_COMPUTE_INTEGRITY))
        return;
    const int repaired = repair(d, region);
    d->counters.integrity_repairs += (uint32_t)repaired;
    if (!repaired && region == UPB_REGION_MODEL && daemon_reacts(d, REACT_REPAIR)) {
        d->integrity.broken = 1;
        daemon_ladder_apply(d);
    }
    daemon_report(d, UPB_FAULT_COMPUTE_INTEGRITY, UPB_MONITOR_FAILED, region);
    daemon_event(d, UPB_EVENT_INTEGRITY, region, (uint32_t)repaired, 0);
}

/* ---------------------------------------------------------------------------------------------- walking */

static uint32_t expected_crc(const upb_daemon *d, uint32_t region) {
    const integrity *i = &d->integrity;
    return region == UPB_REGION_MODEL    ? i->model_crc
           : region == UPB_REGION_KEPT   ? i->kept_crc
           : region == UPB_REGION_STREAM ? i->stream_crc
                                         : i->config_crc;
}

static void next_region(upb_daemon *d) {
    integrity *i = &d->integrity;
    i->at = 0;
    i->crc = 0;
    if (++i->region < UPB_REGIONS)
        return;
    i->region = 0;
    d->counters.integrity_checks++;
    if (i->failures_seen == d->counters.integrity_failures)
        daemon_report(d, UPB_FAULT_COMPUTE_INTEGRITY, UPB_MONITOR_PREPASSED, 0);
    i->failures_seen = d->counters.integrity_failures;
}

/* Whole region by whole region where they fit; the rest of `bytes` goes to the next. */
void daemon_integrity_step(upb_daemon *d, size_t budget) {
    integrity *i = &d->integrity;
    for (unsigned regions = 0; budget && regions < UPB_REGIONS; regions++) {
        const uint32_t region = i->region;
        size_t bytes;
        const uint8_t *at = region_of(d, region, &bytes);
        size_t take = bytes > i->at ? bytes - i->at : 0;
        take = take < budget ? take : budget;
        if (region != UPB_REGION_STREAM)
            i->crc = upb_crc32(i->crc, at + i->at, take);
        else if (d->stream)
            upb_stream_checksum(d->stream, &i->crc);
        else
            i->crc = i->stream_crc;
        i->at += take;
        budget -= take;
        if (i->at < bytes)
            return;
        if (i->crc != expected_crc(d, region))
            found(d, region);
        next_region(d);
    }
}

/* ---------------------------------------------------------------------------------------------- for tests */

size_t upb_daemon_region_bytes(const upb_daemon *d, upb_region region) {
    size_t bytes;
    region_of(d, (uint32_t)region, &bytes);
    return bytes;
}

void upb_daemon_flip_bit(upb_daemon *d, upb_region region, size_t bit) {
    size_t bytes;
    uint8_t *at = (uint8_t *)(uintptr_t)region_of(d, (uint32_t)region, &bytes);
    if (region == UPB_REGION_STREAM && d->stream)
        *upb_stream_test_constant(d->stream) ^= 1u << bit % 32;
    else if (bit / 8 < bytes)
        at[bit / 8] ^= (uint8_t)(1u << bit % 8);
}
