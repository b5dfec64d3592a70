/* Data packets to firings. */
#include <string.h>

#include "packet_record.h"
#include "packet_wire.h"

#define JUMP_CDEG 500 /* from azimuth place to azimuth place: six times what any sensor turns */
#define SMOOTH_PACKETS 16
#define NS_PER_S 1000000000 /* exact in 64 bits times the mdeg of a packet */

upb_packet_decoder_config upb_packet_decoder_config_default(void) {
    upb_packet_decoder_config config;
    memset(&config, 0, sizeof config);
    return config;
}

static void use_calibration(upb_packet_decoder *decoder, const upb_packet_calibration *calibration) {
    decoder->calibration = *calibration;
    for (uint32_t k = 0; k < calibration->beams; k++)
        decoder->slot_beam[calibration->laser[k].laser_id] = (uint8_t)k;
}

static upb_packet_status use_sensor(upb_packet_decoder *decoder, upb_sensor sensor) {
    upb_packet_calibration nominal;
    const upb_packet_status status = upb_packet_calibration_default(sensor, &nominal);
    if (status != UPB_PACKET_OK)
        return status;
    decoder->sensor = sensor;
    use_calibration(decoder, &nominal);
    return UPB_PACKET_OK;
}

upb_packet_status upb_packet_decoder_init(upb_packet_decoder *decoder, const upb_packet_decoder_config *config) {
    if (!decoder || !config || (uint32_t)config->pick > UPB_PICK_LAST || config->keep_calibration > 1)
        return UPB_PACKET_E_ARGUMENT;
    memset(decoder, 0, sizeof *decoder);
    decoder->config = *config;
    decoder->config.calibration = NULL; /* copied: the caller's may go */
    if (config->sensor == UPB_SENSOR_AUTO)
        return config->calibration ? UPB_PACKET_E_ARGUMENT : UPB_PACKET_OK;
    const upb_packet_status status = use_sensor(decoder, config->sensor);
    if (status != UPB_PACKET_OK || !config->calibration)
        return status;
    if (config->calibration->sensor != config->sensor)
        return UPB_PACKET_E_ARGUMENT;
    if (upb_packet_calibration_check(config->calibration, NULL) != UPB_PACKET_OK)
        return UPB_PACKET_E_CALIBRATION;
    use_calibration(decoder, config->calibration);
    return UPB_PACKET_OK;
}

/* ----------------------------------------------------------------------------------------------- azimuth and time */

static int is_jump(int32_t turn_cdeg) { return turn_cdeg > JUMP_CDEG || turn_cdeg < -JUMP_CDEG; }

/* Rotation by the azimuths of a packet, jumps left out; the last packet's where these tell nothing. */
static uint32_t rate_of(const upb_packet_decoder *decoder, const uint8_t *packet, const wire_layout *layout,
                        uint32_t slot_ns) {
    int32_t turned = 0;
    int32_t steps = 0;
    for (uint32_t slot = 1; slot < layout->slots; slot++) {
        const int32_t turn = wire_turn(wire_azimuth(packet, wire_slot_block(layout, slot - 1, 0)),
                                       wire_azimuth(packet, wire_slot_block(layout, slot, 0)));
        if (is_jump(turn))
            continue;
        turned += turn;
        steps++;
    }
    if (steps == 0)
        return decoder->last_rate_mdeg_s;
    if (turned <= 0)
        return 0;
    return (uint32_t)((int64_t)turned * 10 * NS_PER_S / ((int64_t)steps * slot_ns));
}

/* Over some packets: a packet's own, of azimuths in steps of 0.01 degrees, is half a percent off. */
static uint32_t smoothed(upb_packet_decoder *decoder, uint32_t rate_mdeg_s) {
    const int64_t was = decoder->last_rate_mdeg_s;
    const int64_t now = was == 0 ? rate_mdeg_s : was + ((int64_t)rate_mdeg_s - was) / SMOOTH_PACKETS;
    decoder->last_rate_mdeg_s = (uint32_t)now;
    return (uint32_t)now;
}

/* The sensor's clock begins anew every hour; packets may be swapped around that moment. */
static uint64_t unwrapped_ns(upb_packet_decoder *decoder, uint32_t time_us) {
    const uint32_t half = WIRE_HOUR_US / 2;
    if (decoder->stats.firings == 0) {
        decoder->hour_ns = UPB_HOUR_NS;
    } else if (time_us < decoder->last_time_us && decoder->last_time_us - time_us > half) {
        decoder->hour_ns += UPB_HOUR_NS;
        decoder->stats.hours++;
    } else if (time_us > decoder->last_time_us && time_us - decoder->last_time_us > half && decoder->hour_ns) {
        decoder->hour_ns -= UPB_HOUR_NS;
        if (decoder->stats.hours)
            decoder->stats.hours--;
    }
    decoder->last_time_us = time_us;
    return decoder->hour_ns + (uint64_t)time_us * 1000;
}

/* -------------------------------------------------------------------------------------------------------- firings */

/* The returns of one firing: `at` is the first of its lasers, `banks` blocks of `lasers` each. */
static void read_returns(const upb_packet_decoder *decoder, const uint8_t *at, uint32_t banks, uint32_t lasers,
                         upb_firing *firing) {
    uint32_t any = 0;
    const uint8_t *beam_of = decoder->slot_beam;
    for (uint32_t bank = 0; bank < banks; bank++, at += WIRE_BLOCK_BYTES, beam_of += lasers) {
        const uint8_t *p = at;
        for (uint32_t laser = 0; laser < lasers; laser++, p += WIRE_RETURN_BYTES) {
            const uint32_t beam = beam_of[laser];
            const uint32_t distance = wire_get16(p);
            any |= distance;
            firing->distance[beam] = (uint16_t)distance;
            firing->intensity[beam] = p[2];
        }
    }
    const uint32_t beams = banks * lasers;
    memset(firing->distance + beams, 0, (UPB_PACKET_BEAMS - beams) * sizeof firing->distance[0]);
    memset(firing->intensity + beams, 0, UPB_PACKET_BEAMS - beams);
    firing->beams = (uint8_t)beams;
    if (!any)
        firing->flags |= UPB_FIRING_EMPTY;
}

static void mark_empty(upb_firing *firing) {
    uint32_t any = 0;
    for (uint32_t beam = 0; beam < firing->beams; beam++)
        any |= firing->distance[beam];
    firing->flags = (uint16_t)((firing->flags & ~UPB_FIRING_EMPTY) | (any ? 0u : UPB_FIRING_EMPTY));
}

/* Puts the brighter return of each beam into the first. */
static void sort_by_brightness(upb_firing *first, upb_firing *second) {
    for (uint32_t beam = 0; beam < first->beams; beam++) {
        const uint16_t distance = first->distance[beam];
        const uint8_t intensity = first->intensity[beam];
        const int brighter = second->intensity[beam] > intensity;
        if (!second->distance[beam] || (distance && !brighter))
            continue;
        first->distance[beam] = second->distance[beam];
        first->intensity[beam] = second->intensity[beam];
        second->distance[beam] = distance;
        second->intensity[beam] = intensity;
    }
    mark_empty(first);
    mark_empty(second);
}

typedef struct packet_motion {
    wire_layout layout;
    uint32_t cycle_ns;
    uint32_t rate_mdeg_s;
    uint32_t smooth_rate_mdeg_s;
    uint64_t time_ns;
    uint8_t single_kind; /* upb_return_mode of a packet that is not dual */
} packet_motion;

/* What the azimuth jumped over just before slot `slot`, in time; 0: it did not jump. */
static uint64_t jumped_ns(const uint8_t *packet, const packet_motion *motion, uint32_t slot) {
    const uint32_t before = wire_azimuth(packet, wire_slot_block(&motion->layout, slot - 1, 0));
    const uint32_t here = wire_azimuth(packet, wire_slot_block(&motion->layout, slot, 0));
    const uint64_t slot_ns = (uint64_t)motion->cycle_ns * motion->layout.firings_per_block;
    if (!is_jump(wire_turn(before, here)))
        return 0;
    if (motion->smooth_rate_mdeg_s == 0)
        return 1; /* unknown, and yet a jump */
    const uint64_t turned_mdeg = 10 * ((here + WIRE_FULL_TURN_CDEG - before) % WIRE_FULL_TURN_CDEG);
    const uint64_t took_ns = turned_mdeg * NS_PER_S / motion->smooth_rate_mdeg_s;
    return took_ns > slot_ns ? took_ns - slot_ns : 1;
}

/* All but the returns: azimuth, time, flags of firing `f` of slot `slot`. */
static void place_firing(const uint8_t *packet, const packet_motion *motion, uint32_t slot, uint32_t f,
                         upb_firing *firing) {
    const wire_layout *layout = &motion->layout;
    const uint32_t azimuth = wire_azimuth(packet, wire_slot_block(layout, slot, 0));
    const uint32_t since_ns = f * motion->cycle_ns;
    const uint64_t turned = ((uint64_t)motion->rate_mdeg_s * since_ns + NS_PER_S / 2) / NS_PER_S;
    firing->flags = f ? UPB_FIRING_INTERPOLATED : 0;
    firing->azimuth_mdeg = (uint32_t)((10 * azimuth + turned) % UPB_FULL_TURN_MDEG);
    firing->rate_mdeg_s = motion->rate_mdeg_s;
    firing->time_ns = motion->time_ns + (uint64_t)(slot * layout->firings_per_block + f) * motion->cycle_ns;
    firing->return_kind = motion->single_kind;
}

/* Firing `f` of slot `slot`, and in dual return its second: how many were written. */
static uint32_t read_firing(const upb_packet_decoder *decoder, const uint8_t *packet, const packet_motion *motion,
                            uint32_t slot, uint32_t f, upb_firing *firing) {
    const wire_layout *layout = &motion->layout;
    const uint32_t lasers = WIRE_BLOCK_LASERS / layout->firings_per_block;
    const uint32_t place = WIRE_RETURNS_AT + f * lasers * WIRE_RETURN_BYTES;
    place_firing(packet, motion, slot, f, firing);
    if (layout->returns == 1) {
        read_returns(decoder, wire_block(packet, wire_slot_block(layout, slot, 0)) + place, layout->blocks_per_firing,
                     lasers, firing);
        return 1;
    }
    const int by_brightness = decoder->config.pick == UPB_PICK_STRONGEST;
    const uint32_t primary = by_brightness ? !layout->last_at : layout->last_at;
    firing->flags |= UPB_FIRING_DUAL;
    firing[1] = firing[0];
    firing[1].flags |= UPB_FIRING_SECOND;
    for (uint32_t k = 0; k < 2; k++) {
        const uint32_t which = k == 0 ? primary : !primary;
        firing[k].return_kind = which == layout->last_at ? UPB_RETURN_LAST : UPB_RETURN_STRONGEST;
        read_returns(decoder, wire_block(packet, wire_slot_block(layout, slot, which)) + place,
                     layout->blocks_per_firing, lasers, &firing[k]);
    }
    if (by_brightness)
        sort_by_brightness(&firing[0], &firing[1]);
    return 2;
}

static uint32_t read_firings(upb_packet_decoder *decoder, const uint8_t *packet, const upb_packet_info *info,
                             upb_firing *firings) {
    packet_motion motion;
    motion.layout = wire_layout_of(decoder->sensor, info->return_mode);
    motion.cycle_ns = upb_sensor_info_get(decoder->sensor)->firing_cycle_ns;
    motion.rate_mdeg_s = rate_of(decoder, packet, &motion.layout, motion.cycle_ns * motion.layout.firings_per_block);
    motion.time_ns = unwrapped_ns(decoder, info->time_us);
    motion.single_kind = (uint8_t)info->return_mode;
    motion.smooth_rate_mdeg_s = smoothed(decoder, motion.rate_mdeg_s);
    uint32_t count = 0;
    for (uint32_t slot = 0; slot < motion.layout.slots; slot++) {
        const uint32_t first = count;
        const uint64_t jumped = slot > 0 ? jumped_ns(packet, &motion, slot) : 0;
        motion.time_ns += jumped;
        for (uint32_t f = 0; f < motion.layout.firings_per_block; f++)
            count += read_firing(decoder, packet, &motion, slot, f, &firings[count]);
        if (jumped) {
            firings[first].flags |= UPB_FIRING_JUMP;
            decoder->stats.jumps++;
        }
    }
    decoder->stats.firings += count;
    return count;
}

/* ------------------------------------------------------------------------------------------------ HDL-64E's status */

static uint8_t *status_field(upb_hdl64e_status *status, uint8_t type) {
    switch (type) {
    case 'H':
        return &status->hour;
    case 'M':
        return &status->minute;
    case 'S':
        return &status->second;
    case 'D':
        return &status->day;
    case 'N':
        return &status->month;
    case 'Y':
        return &status->year;
    case 'G':
        return &status->gps;
    case 'T':
        return &status->temperature_c;
    case 'V':
        return &status->firmware;
    default:
        return NULL;
    }
}

/* Where a record begins in a ring of its size; UPB_RECORD_BYTES: nowhere. */
static uint32_t find_record(const uint8_t *ring) {
    static const uint8_t begin[5] = {'U', 'N', 'I', 'T', '#'};
    for (uint32_t start = 0; start < UPB_RECORD_BYTES; start++) {
        uint32_t same = 0;
        while (same < sizeof begin && ring[(start + same) % UPB_RECORD_BYTES] == begin[same])
            same++;
        if (same == sizeof begin)
            return start;
    }
    return UPB_RECORD_BYTES;
}

static void use_record(upb_packet_decoder *decoder, const upb_packet_calibration *calibration) {
    decoder->stats.records++;
    decoder->sensor = calibration->sensor;
    if (!decoder->config.keep_calibration)
        use_calibration(decoder, calibration);
}

/* The ring is full: a record that began anywhere in it is whole, unless packets were lost. Then what follows the last
 * beginning is kept, so that the next round is in step. */
static void read_record(upb_packet_decoder *decoder) {
    upb_packet_calibration calibration;
    upb_hdl64e_status status = decoder->status;
    uint8_t turned[UPB_RECORD_BYTES];
    const uint32_t start = find_record(decoder->record);
    const uint32_t after = UPB_RECORD_BYTES - start;
    decoder->record_bytes = 0;
    if (after > 0) {
        memcpy(turned, decoder->record + start, after);
        memcpy(turned + after, decoder->record, start);
        if (upb_record_read(turned, &calibration, &status) == UPB_PACKET_OK) {
            decoder->status = status;
            use_record(decoder, &calibration);
            return;
        }
        if (start > 0) {
            memcpy(decoder->record, turned, after);
            decoder->record_bytes = after;
        }
    }
    decoder->stats.records_bad++;
}

static void take_status(upb_packet_decoder *decoder, const upb_packet_info *info) {
    uint8_t *field = status_field(&decoder->status, info->status_type);
    if (field) {
        *field = info->status_value;
        return;
    }
    if (info->status_type == 'W')
        decoder->status.warnings = info->status_value;
    decoder->record[decoder->record_bytes++] = info->status_value;
    if (decoder->record_bytes == UPB_RECORD_BYTES)
        read_record(decoder);
}

/* ---------------------------------------------------------------------------------------------------------- decode */

static upb_packet_status match_sensor(upb_packet_decoder *decoder, upb_packet_info *info) {
    if (decoder->sensor == UPB_SENSOR_AUTO)
        return use_sensor(decoder, info->sensor);
    if (wire_is_hdl64e(decoder->sensor) && wire_is_hdl64e(info->sensor)) {
        info->sensor = decoder->sensor;
        return UPB_PACKET_OK;
    }
    return decoder->sensor == info->sensor ? UPB_PACKET_OK : UPB_PACKET_E_SENSOR;
}

static upb_packet_status decode(upb_packet_decoder *decoder, const uint8_t *bytes, size_t n, upb_firing *firings,
                                uint32_t *count, upb_packet_info *info) {
    upb_packet_status status = upb_packet_identify(bytes, n, info);
    if (status != UPB_PACKET_OK)
        return status;
    if (info->kind == UPB_PACKET_KIND_POSITION) {
        decoder->stats.positions++;
        return UPB_PACKET_OK;
    }
    status = match_sensor(decoder, info);
    if (status != UPB_PACKET_OK)
        return status;
    /* A packet that came twice would put its status byte into the record twice. */
    const int again = decoder->stats.firings > 0 && info->time_us == decoder->last_time_us;
    *count = read_firings(decoder, bytes, info, firings);
    if (wire_is_hdl64e(decoder->sensor) && !again)
        take_status(decoder, info);
    return UPB_PACKET_OK;
}

upb_packet_status upb_packet_decode(upb_packet_decoder *decoder, const uint8_t *bytes, size_t n,
                                    upb_firing firings[UPB_PACKET_FIRINGS], uint32_t *count, upb_packet_info *info) {
    upb_packet_info own;
    if (!decoder || !bytes || !firings || !count)
        return UPB_PACKET_E_ARGUMENT;
    *count = 0;
    const upb_packet_status status = decode(decoder, bytes, n, firings, count, info ? info : &own);
    decoder->stats.packets[status]++;
    return status;
}
