#include "live_consumer.h"

#include <string.h>

static void show(_Atomic uint64_t *shown, uint64_t value) { atomic_store_explicit(shown, value, memory_order_relaxed); }

/* ---------------------------------------------------------------------------------------------- output images */

static live_image *choose_image(live_consumer *c, uint64_t frame) {
    const upb_live_config *config = c->config;
    live_image *image;

    while (c->keep_next < config->keep_count && config->keep_frames[c->keep_next] < frame)
        c->keep_next++;
    if (c->keep_next < config->keep_count && config->keep_frames[c->keep_next] == frame) {
        image = &c->images[c->keep_next];
    } else {
        image = &c->images[config->keep_count + c->spare];
        c->spare ^= 1u;
        memset(image->distance, 0, (size_t)config->columns * UPB_ROWS * sizeof *image->distance);
        memset(image->intensity, 0, (size_t)config->columns * UPB_ROWS);
    }
    image->frame = frame;
    image->columns_out = 0;
    return image;
}

static void store_column(live_consumer *c, uint64_t frame, const upb_column *column) {
    const size_t at = (size_t)column->column * UPB_ROWS;

    if (c->image == NULL || c->image->frame != frame)
        c->image = choose_image(c, frame);
    memcpy(c->image->distance + at, column->distance, UPB_ROWS * sizeof *column->distance);
    memcpy(c->image->intensity + at, column->intensity, UPB_ROWS);
    c->image->columns_out++;
}

/* ------------------------------------------------------------------------------------------------------ ledger */

static uint32_t received_columns(const live_consumer *c, uint64_t frame) {
    const live_received *r = &c->received[frame % LIVE_OPEN_FRAMES];
    return r->frame == frame ? r->columns : 0;
}

static void count_received(live_consumer *c, uint64_t frame, uint32_t columns) {
    live_received *r = &c->received[frame % LIVE_OPEN_FRAMES];
    if (r->frame != frame) {
        r->frame = frame;
        r->columns = 0;
    }
    r->columns += columns;
}

static void show_progress(live_consumer *c, const upb_ledger_record *record) {
    show(&c->shown_frames, c->frame_count);
    show(&c->shown_missed, c->ledger.missed);
    if (record->verdict != (uint32_t)UPB_VERDICT_PARTIAL) {
        show(&c->shown_last_ns, record->latency_ns);
        show(&c->shown_max_ns, c->ledger.latency.max_ns);
    }
}

/* `end`: the sensor has sent the frame's columns before this one. */
static void close_frame(live_consumer *c, uint64_t frame, uint32_t end, uint32_t partial) {
    const uint32_t sent = frame == 0 ? end - c->shift : end;
    const uint32_t received = received_columns(c, frame);
    upb_ledger_record record;

    if (upb_ledger_output(&c->ledger, frame, sent - received, partial, UPB_MODE_NETWORK, &record) != UPB_OK) {
        c->frames_empty++; /* the ledger never saw the frame: no column of it arrived */
        return;
    }
    if (c->frame_count < c->frame_capacity) {
        upb_live_frame *f = &c->frames[c->frame_count++];
        f->record = record;
        f->columns_received = received;
        f->flags = c->flushing ? UPB_LIVE_FLUSHED : 0;
        f->wait_ns = c->packet_ns > record.last_input_ns ? c->packet_ns - record.last_input_ns : 0;
    }
    show_progress(c, &record);
}

void live_consumer_on_column(void *user, const upb_column *column) {
    live_consumer *c = user;
    const uint64_t frame = c->base_frame + column->frame;

    if (c->probing) {
        c->shift = column->column;
        return;
    }
    c->columns_out++;
    if (column->flags & UPB_COLUMN_INCOMPLETE)
        c->columns_incomplete++;
    store_column(c, frame, column);
    if (column->flags & UPB_COLUMN_LAST) {
        c->last = c->image;
        close_frame(c, frame, c->config->columns, frame == c->base_frame && c->begins_late);
    }
}

/* ------------------------------------------------------------------------------------------------------- input */

upb_status live_consumer_attach(live_consumer *c, upb_stream *stream) {
    static const uint16_t no_distance[UPB_BEAMS];
    static const uint8_t no_intensity[UPB_BEAMS];

    c->stream = stream;
    c->probing = 1;
    upb_status status = upb_stream_push(stream, 0, no_distance, no_intensity);
    if (status == UPB_OK)
        status = upb_stream_flush(stream);
    c->probing = 0;
    /* A shifted turn lies in two frames: one more comes out than was played. */
    c->frames_total = c->config->frames_total + (c->shift != 0);
    return status == UPB_OK ? upb_stream_reset(stream) : status;
}

/* The stream alone could not tell two turns lost from one: the packets' sequence can. */
static void insert_missing(live_consumer *c, uint64_t until_column) {
    while (c->next_column < until_column) {
        const uint64_t left = until_column - c->next_column;
        const uint32_t columns = left < c->config->columns ? (uint32_t)left : c->config->columns;
        upb_stream_gap(c->stream, columns);
        c->next_column += columns;
    }
}

static void begin(live_consumer *c, const live_packet *packet) {
    c->started = 1;
    c->base_frame = (packet->first_column + c->shift) / c->config->columns;
    c->begins_late = (packet->first_column + c->shift) % c->config->columns != 0;
    /* Whole frames before the first packet: there is no stream yet that could hand them out. */
    c->frames_empty += c->base_frame;
    c->next_column = packet->first_column;
}

static void push_column(live_consumer *c, const live_packet *packet, uint32_t index) {
    const uint64_t at = packet->first_column + index;
    const uint64_t frame = (at + c->shift) / c->config->columns;
    const size_t pixel = (size_t)index * UPB_BEAMS;

    upb_ledger_input(&c->ledger, frame, packet->received_ns);
    count_received(c, frame, 1);
    if (upb_stream_push(c->stream, (uint32_t)(at % c->config->columns), packet->distance + pixel,
                        packet->intensity + pixel) != UPB_OK)
        c->columns_refused++;
}

void live_consumer_take(live_consumer *c, const live_packet *packet) {
    const uint64_t start = live_clock_now(c->clock);

    c->packet_ns = packet->received_ns;
    if (!c->started)
        begin(c, packet);
    insert_missing(c, packet->first_column);
    uint64_t before = live_clock_now(c->clock);
    for (uint32_t i = 0; i < packet->columns; i++) {
        live_clock_column(c->clock, i, packet->columns);
        push_column(c, packet, i);
        const uint64_t now = live_clock_now(c->clock);
        upb_histogram_add(&c->column_compute, now - before);
        before = now;
    }
    c->next_column += packet->columns;
    c->packets_taken++;
    c->columns_taken += packet->columns;
    upb_histogram_add(&c->packet_compute, before - start);
}

void live_consumer_finish(live_consumer *c, uint64_t columns_played) {
    const uint32_t columns = c->config->columns;
    const uint64_t cut_frame = (columns_played + c->shift) / columns;
    const uint32_t cut_columns = (uint32_t)((columns_played + c->shift) % columns);

    if (columns_played == 0)
        return;
    if (!c->started) {
        c->frames_empty = cut_frame + (cut_columns != 0);
        return;
    }
    c->flushing = 1;
    insert_missing(c, columns_played);
    upb_stream_flush(c->stream);
    if (cut_columns != 0 && received_columns(c, cut_frame) == 0)
        c->frames_empty++;
    /* What is open now was cut off by the end of the stream. */
    while (c->ledger.open_count > 0) {
        const uint64_t frame = c->ledger.open[0].frame;
        close_frame(c, frame, frame == cut_frame ? cut_columns : columns, 1);
    }
}
