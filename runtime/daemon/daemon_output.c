/* Finished columns -> datagrams of the column stream, and HDL-64E packets; a frame closes when its last one has left.
 */
#include <string.h>

#include "daemon_internal.h"

/* ------------------------------------------------------------------------------------------ column stream */

static void send_wire(upb_daemon *d) {
    upb_wire_header *header = &d->wire_header;
    if (!header->columns)
        return;
    header->sequence = d->wire_sequence++;
    upb_wire_write_header(header, d->wire);
    d->counters.column_datagrams++;
    d->config.sinks.column_stream(d->config.sinks.user, daemon_now(d), d->wire, upb_wire_bytes(header->columns));
    header->columns = 0;
}

static void add_to_wire(upb_daemon *d, const upb_wire_column *column, uint64_t frame) {
    upb_wire_header *header = &d->wire_header;
    if (header->columns && header->frame != frame)
        send_wire(d);
    header->frame = frame;
    upb_wire_write_column(column, header->columns++, d->wire);
    if (header->columns == UPB_WIRE_COLUMNS || (column->flags & UPB_COLUMN_LAST))
        send_wire(d);
}

/* ---------------------------------------------------------------------------------------------- HDL-64E */

static void encode(upb_daemon *d, const upb_firing *firing) {
    uint8_t packet[UPB_PACKET_BYTES];
    uint32_t ready = 0;
    const upb_packet_status status = upb_packet_encode(&d->encoder, firing, packet, &ready);
    d->counters.hdl64_beyond_range = d->encoder.stats.too_far;
    if (status != UPB_PACKET_OK || !ready)
        return;
    d->counters.hdl64_packets++;
    d->config.sinks.hdl64(d->config.sinks.user, daemon_now(d), packet, sizeof packet);
}

static void add_to_hdl64(upb_daemon *d, const upb_wire_column *column) {
    upb_firing firing = {.time_ns = column->time_ns, .azimuth_mdeg = column->azimuth_mdeg, .beams = UPB_ROWS};
    firing.return_kind = UPB_RETURN_STRONGEST;
    memcpy(firing.distance, column->distance, sizeof column->distance);
    memcpy(firing.intensity, column->intensity, sizeof column->intensity);
    firing.distance[UPB_ROWS - 1] = 0; /* row 63 lies below the last beam: nothing is known there */
    firing.intensity[UPB_ROWS - 1] = 0;
    d->hdl64_azimuth_mdeg = column->azimuth_mdeg;
    d->hdl64_time_ns = column->time_ns;
    encode(d, &firing);
}

/* A packet that no column will fill any more is filled with firings of no return. */
static void fill_hdl64(upb_daemon *d) {
    upb_firing firing = {.beams = UPB_ROWS, .return_kind = UPB_RETURN_STRONGEST};
    const uint32_t step = UPB_FULL_TURN_MDEG / d->columns;
    while (upb_packet_encoder_pending(&d->encoder)) {
        d->hdl64_azimuth_mdeg = (d->hdl64_azimuth_mdeg + step) % UPB_FULL_TURN_MDEG;
        d->hdl64_time_ns += d->cycle_ns;
        firing.azimuth_mdeg = d->hdl64_azimuth_mdeg;
        firing.time_ns = d->hdl64_time_ns;
        d->counters.hdl64_padding++;
        encode(d, &firing);
    }
}

/* Where a pixel of beam k lies beside its column's azimuth: whole columns of its offset are gone by the ring, what
 * remains and the turn until it fires do not. At the speed of a turn of d->columns. */
static int32_t residual_mdeg(const upb_daemon *d, unsigned k) {
    const upb_laser *laser = &d->decoder.calibration.laser[k];
    const int64_t columns = d->columns, turn = UPB_FULL_TURN_MDEG;
    const int64_t whole = d->offset[k] * turn / columns;
    const int64_t fired = (int64_t)laser->fire_time_ns * turn / ((int64_t)d->cycle_ns * columns);
    return (int32_t)(laser->azimuth_offset_mdeg - whole + fired);
}

static void make_calibration(upb_daemon *d) {
    const upb_model_info *info = &d->slot[d->active].info;
    int32_t elevation_mdeg[UPB_ROWS];
    for (unsigned row = 0; row < UPB_ROWS; row++)
        elevation_mdeg[row] = (info->row_elevation_udeg[row] + (info->row_elevation_udeg[row] < 0 ? -500 : 500)) / 1000;
    if (upb_packet_calibration_rows(elevation_mdeg, d->calibration_columns, &d->calibration) != UPB_PACKET_OK)
        return;
    for (unsigned row = 0; row < UPB_ROWS; row++) {
        const unsigned k = row / 2, below = row + 1 < UPB_ROWS && row % 2 ? k + 1 : k;
        const int32_t residual = residual_mdeg(d, k) + residual_mdeg(d, below); /* twice it */
        /* In whole steps of the record, so that it adds no rounding to the table's own. */
        d->calibration.laser[row].azimuth_offset_mdeg += (residual + (residual < 0 ? -10 : 10)) / 20 * 10;
    }
}

/* ------------------------------------------------------------------------------------------------- both */

static void close_waiting(upb_daemon *d) {
    if (!d->closing_set)
        return;
    d->closing_set = 0;
    daemon_close_frame(d, d->closing);
}

void daemon_output_column(upb_daemon *d, const upb_wire_column *column, const upb_wire_column *second, uint64_t frame) {
    const upb_daemon_sinks *sinks = &d->config.sinks;
    const int last = ((second ? second : column)->flags & UPB_COLUMN_LAST) != 0;
    if (sinks->column_stream) {
        add_to_wire(d, column, frame);
        if (second)
            add_to_wire(d, second, frame);
    }
    if (sinks->hdl64 && d->encoder_made) {
        const uint64_t before = d->counters.hdl64_packets;
        add_to_hdl64(d, column);
        if (d->counters.hdl64_packets != before)
            close_waiting(d);
    }
    if (last) {
        close_waiting(d);
        d->closing = frame;
        d->closing_set = 1;
        if (!sinks->hdl64 || !d->encoder_made || !upb_packet_encoder_pending(&d->encoder))
            close_waiting(d);
    }
}

void daemon_output_end(upb_daemon *d) {
    if (d->config.sinks.column_stream)
        send_wire(d);
    if (d->config.sinks.hdl64 && d->encoder_made)
        fill_hdl64(d);
    close_waiting(d);
}

void daemon_output_begin(upb_daemon *d) {
    const upb_model_info *info = &d->slot[d->active].info;
    d->wire_header.model_crc32 = info->crc32;
    d->wire_header.distance_unit_um = info->distance_unit_um;
    d->wire_header.turn_columns = d->columns;
    if (d->encoder_made && d->columns == d->calibration_columns)
        return;
    d->calibration_columns = d->columns;
    make_calibration(d);
    if (d->encoder_made) {
        upb_packet_encoder_set_record(&d->encoder, &d->calibration);
        return;
    }
    upb_packet_encoder_config config = upb_packet_encoder_config_default(UPB_SENSOR_HDL_64E_S3);
    config.calibration = &d->calibration;
    config.distance_unit_um = info->distance_unit_um;
    d->encoder_made = upb_packet_encoder_init(&d->encoder, &config) == UPB_PACKET_OK;
}
