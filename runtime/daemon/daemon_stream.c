/*
 * Firings -> columns. Firings are numbered as they are pushed, inserted ones included; the stream gives one column for
 * each, in the same order, delay_columns later. What belongs to a column besides its counts waits in notes[].
 */
#include <string.h>

#include "daemon_internal.h"
#include "upb_internal.h"

enum { FOV_MARGIN_MDEG = 3000 };

_Static_assert((FIRINGS_KEPT & (FIRINGS_KEPT - 1)) == 0, "notes are found by masking");

static firing_note *note_of(upb_daemon *d, uint64_t number) { return &d->notes[number & (FIRINGS_KEPT - 1u)]; }

/* ------------------------------------------------------------------------------------------ open frames */

static open_frame *frame_of(upb_daemon *d, uint64_t frame) { return &d->frames[frame % OPEN_FRAMES]; }

/* The frame of the next firing becomes `frame`. */
static void open_new_frame(upb_daemon *d, uint64_t frame, int partial) {
    d->frame = frame;
    d->frame_column = 0;
    d->frame_open = 1;
    *frame_of(d, frame) = (open_frame){.frame = frame, .partial = (uint32_t)partial};
}

void daemon_close_frame(upb_daemon *d, uint64_t number) {
    const open_frame *frame = frame_of(d, number);
    upb_ledger_record record;
    if (frame->frame != number)
        return;
    if (upb_ledger_output(&d->ledger, number, frame->inserted, frame->partial, frame->mode, &record) != UPB_OK) {
        d->counters.frames_skipped++; /* no firing of it arrived: the ledger never saw it */
        return;
    }
    d->counters.frames_closed++;
    if (record.verdict == UPB_VERDICT_PARTIAL)
        d->counters.frames_partial++;
    else {
        d->last_latency_ns = record.latency_ns;
        d->counters.frames_missed += record.verdict == UPB_VERDICT_MISSED;
        daemon_report(d, UPB_FAULT_COMPUTE_DEADLINE,
                      record.verdict == UPB_VERDICT_MISSED ? UPB_MONITOR_PREFAILED : UPB_MONITOR_PREPASSED,
                      record.latency_ns);
    }
    upb_bus_ledger(&d->bus, &record);
    if (d->config.sinks.ledger)
        d->config.sinks.ledger(d->config.sinks.user, &record);
}

/* --------------------------------------------------------------------------------------------- columns out */

/* The other return of the finished column, put together from the firings that its beams are of. */
static int second_column(upb_daemon *d, upb_wire_column *second) {
    int any = 0;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        /* Beam k of azimuth column c is of firing c - offset[k]; this is column out + shift. */
        const uint64_t number = d->out + (uint64_t)(int64_t)(d->shift - d->offset[k]);
        const int is_there = number >= d->segment && number < d->pushed && number + FIRINGS_KEPT > d->pushed;
        const firing_note *note = note_of(d, number);
        const int has = is_there && (note->flags & UPB_WIRE_SECOND);
        second->distance[2 * k] = has ? note->second_distance[k] : 0;
        second->intensity[2 * k] = has ? note->second_intensity[k] : 0;
        second->distance[2 * k + 1] = 0;
        second->intensity[2 * k + 1] = 0;
        any |= has;
    }
    return any;
}

static void on_column(void *user, const upb_column *finished) {
    upb_daemon *d = user;
    const firing_note *note = note_of(d, d->out);
    const int last = d->out + 1 == d->pushed ? d->ending != 0 : note_of(d, d->out + 1)->frame != note->frame;
    const uint32_t turn = UPB_FULL_TURN_MDEG;
    const int64_t shifted = (int64_t)note->azimuth_mdeg + (int64_t)d->shift * turn / (int64_t)d->columns;
    const upb_mode mode = upb_column_mode(finished);
    upb_wire_column column = {.column = note->column,
                              .azimuth_mdeg = (uint32_t)((shifted + turn) % turn),
                              .time_ns = note->time_ns,
                              .flags = (finished->flags & ~(uint32_t)UPB_COLUMN_LAST) | (last ? UPB_COLUMN_LAST : 0) |
                                       (note->flags & UPB_WIRE_INSERTED)};
    memcpy(column.distance, finished->distance, sizeof column.distance);
    memcpy(column.intensity, finished->intensity, sizeof column.intensity);

    upb_wire_column second = column;
    const int has_second = d->second_end && d->out <= d->second_end + d->delay_columns && second_column(d, &second);
    second.flags = UPB_WIRE_SECOND | (column.flags & UPB_COLUMN_LAST);
    if (has_second)
        column.flags &= ~(uint32_t)UPB_COLUMN_LAST; /* the frame's last record is the second return */

    open_frame *frame = frame_of(d, note->frame);
    if (mode > frame->mode)
        frame->mode = mode;
    d->counters.columns_out++;
    d->counters.columns_by_mode[mode]++;
    d->counters.second_returns += (uint32_t)has_second;
    d->out++;
    daemon_output_column(d, &column, has_second ? &second : NULL, note->frame);
}

/* --------------------------------------------------------------------------------------------- the stream */

static upb_stream_config stream_config(const upb_daemon_config *config, uint32_t columns) {
    upb_stream_config c = upb_stream_config_default();
    c.precision = config->precision;
    c.cpu = config->cpu;
    c.columns = columns;
    c.any_sensor = 1;
    c.distance_unit_um = upb_sensor_info_get((upb_sensor)config->sensor)->distance_unit_um;
    c.sink = on_column;
    return c;
}

upb_status daemon_check_model(const upb_daemon_config *config, const upb_model *model, int any_model,
                              upb_error *error) {
    upb_model_info info;
    upb_status status = upb_model_get_info(model, &info);
    const char *name = upb_sensor_info_get((upb_sensor)config->sensor)->name;
    if (status == UPB_OK && !any_model && strcmp(info.sensor, name) != 0)
        return upb_fail(error, UPB_E_SENSOR, "SENS.name", 0, 0, 0);
    if (status == UPB_OK && info.edge != UPB_EDGE_SEAM)
        return upb_fail(error, UPB_E_SENSOR, "SENS.edge", 0, info.edge, UPB_EDGE_SEAM);
    if (status != UPB_OK)
        return status;
    /* The widest turn has the longest ring. */
    const upb_stream_config stream = stream_config(config, TURN_COLUMNS_MAX);
    upb_sizes sizes;
    status = upb_stream_sizes(model, &stream, &sizes, error);
    if (status != UPB_OK)
        return status;
    int32_t least = INT32_MAX, most = INT32_MIN;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const int32_t offset = upb_offset_columns(info.azimuth_offset_udeg[k], TURN_COLUMNS_MAX);
        least = offset < least ? offset : least;
        most = offset > most ? offset : most;
    }
    if (most - least + 2 >= FIRINGS_KEPT || sizes.state > STREAM_BYTES)
        return upb_fail(error, UPB_E_SENSOR, "SENS.azimuth_offset", 0, (uint64_t)(most - least), FIRINGS_KEPT - 3);
    return UPB_OK;
}

static void plan_offsets(upb_daemon *d, uint32_t columns, int32_t offset[UPB_BEAMS], int32_t *shift) {
    int32_t least = INT32_MAX, most = INT32_MIN;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        offset[k] = upb_offset_columns(d->slot[d->active].info.azimuth_offset_udeg[k], columns);
        least = offset[k] < least ? offset[k] : least;
        most = offset[k] > most ? offset[k] : most;
    }
    *shift = least > 0 ? least : most < 0 ? most : 0;
}

void daemon_begin_stream(upb_daemon *d, uint32_t columns) {
    upb_stream_config config = stream_config(&d->config, columns);
    upb_stream_stats stats;
    config.user = d;
    d->stream = NULL;
    if (upb_stream_init(d->stream_memory, STREAM_BYTES, d->slot[d->active].model, &config, &d->stream, NULL) != UPB_OK)
        return; /* cannot be: the same was checked when the model was taken */
    upb_stream_get_stats(d->stream, &stats);
    plan_offsets(d, columns, d->offset, &d->shift);
    if (columns != d->columns)
        daemon_event(d, UPB_EVENT_STREAM_MADE, columns, 0, 0);
    d->columns = columns;
    d->delay_columns = stats.delay_columns;
    d->segment = d->out = d->pushed;
    d->counters.streams_made++;
    daemon_ladder_apply(d);
    daemon_output_begin(d);
    daemon_integrity_stream_made(d);
}

void daemon_end_segment(upb_daemon *d, int partial) {
    if (!d->stream)
        return;
    d->ending = 1;
    if (partial && d->frame_open)
        frame_of(d, d->frame)->partial = 1;
    upb_stream_flush(d->stream);
    d->ending = 0;
    daemon_output_end(d);
    d->stream = NULL;
    d->frame_open = 0;
}

void daemon_drop_segment(upb_daemon *d) {
    if (!d->stream)
        return;
    const uint64_t first = d->out < d->pushed ? note_of(d, d->out)->frame : d->frame;
    d->counters.columns_lost += d->pushed - d->out;
    d->out = d->pushed;
    d->stream = NULL;
    d->frame_open = 0;
    daemon_output_end(d);
    for (uint64_t frame = first; frame <= d->frame; frame++) {
        frame_of(d, frame)->partial = 1;
        daemon_close_frame(d, frame);
    }
}

void daemon_forget_turn(upb_daemon *d) {
    upb_azimuth_tracker_init(&d->tracker, d->tracker.cut_mdeg, d->cycle_ns);
    d->frame_base = d->counters.firings_processed || d->frame ? d->frame + 1 : 0;
    d->stuck_run = 0;
}

/* ------------------------------------------------------------------------------------------- firings in */

static int is_a_turn(uint32_t columns) { return columns >= TURN_COLUMNS_MIN && columns <= TURN_COLUMNS_MAX; }

/* Does the speed ask for another stream? Only if a beam's offset would change its column. */
static uint32_t wanted_columns(upb_daemon *d) {
    const uint32_t measured = upb_azimuth_turn_firings(&d->tracker);
    int32_t offset[UPB_BEAMS], shift;
    if (!is_a_turn(measured))
        return d->columns;
    const uint32_t apart = measured > d->columns ? measured - d->columns : d->columns - measured;
    if ((uint64_t)apart * 1000 <= (uint64_t)d->columns * d->config.width_tolerance_permille)
        return d->columns;
    plan_offsets(d, measured, offset, &shift);
    return memcmp(offset, d->offset, sizeof offset) == 0 ? d->columns : measured;
}

/* Columns of a turn for a segment that begins with `firing`: as before, as configured, as its packet tells. */
static uint32_t first_columns(upb_daemon *d, const upb_firing *firing) {
    if (d->columns)
        return wanted_columns(d);
    const uint64_t rate = d->config.rpm         ? (uint64_t)d->config.rpm * 6000
                          : firing->rate_mdeg_s ? firing->rate_mdeg_s
                                                : UINT64_C(3600000);
    const uint64_t per_turn = (uint64_t)UPB_FULL_TURN_MDEG * NS_PER_S, step = rate * d->cycle_ns;
    const uint64_t columns = (per_turn + step / 2) / step;
    return columns < TURN_COLUMNS_MIN   ? TURN_COLUMNS_MIN
           : columns > TURN_COLUMNS_MAX ? TURN_COLUMNS_MAX
                                        : (uint32_t)columns;
}

/* Between two segments only. */
static void use_pending_model(upb_daemon *d) {
    if (d->pending == NO_SLOT)
        return;
    d->active = d->pending;
    d->pending = NO_SLOT;
    daemon_integrity_init(d);
    d->counters.models_swapped++;
    daemon_event(d, UPB_EVENT_MODEL_SWAPPED, 0, 0, d->slot[d->active].info.crc32);
    daemon_ladder_apply(d); /* a good model ends what a broken one had forced */
}

/* What waits for a frame boundary: another model, another width. */
static void at_frame_boundary(upb_daemon *d) {
    const uint32_t columns = wanted_columns(d);
    if (d->pending != NO_SLOT || columns != d->columns)
        daemon_end_segment(d, 0);
    use_pending_model(d);
    if (!d->stream)
        daemon_begin_stream(d, columns);
}

/* The next firing, or an inserted one, is of this frame. */
static void enter_frame(upb_daemon *d, uint64_t frame, int begins_late) {
    if (d->frame_open && frame == d->frame)
        return;
    if (d->frame_open) {
        daemon_health_look(d, !frame_of(d, d->frame)->partial);
        at_frame_boundary(d);
    }
    open_new_frame(d, frame, begins_late);
}

static firing_note *next_note(upb_daemon *d, uint64_t time_ns, uint32_t azimuth_mdeg, uint32_t flags) {
    firing_note *note = note_of(d, d->pushed);
    note->time_ns = time_ns;
    note->azimuth_mdeg = azimuth_mdeg;
    note->flags = flags;
    note->frame = d->frame;
    note->column = d->frame_column++;
    d->pushed++;
    return note;
}

static uint32_t azimuth_at(const upb_daemon *d, int64_t angle_mdeg) {
    const int64_t turn = UPB_FULL_TURN_MDEG, azimuth = (d->tracker.cut_mdeg + angle_mdeg) % turn;
    return (uint32_t)(azimuth < 0 ? azimuth + turn : azimuth);
}

/* Firings between the last one and this never arrived: their places lie evenly between. */
static void insert_missing(upb_daemon *d, const upb_step *step, uint64_t time_ns) {
    const int64_t gaps = (int64_t)step->missing + 1;
    const int64_t angle = step->angle_mdeg - d->last_angle_mdeg;
    const int64_t time = (int64_t)(time_ns - d->last_time_ns);
    for (int64_t i = 1; i < gaps; i++) {
        const int64_t at = d->last_angle_mdeg + angle * i / gaps;
        const uint64_t turns = (uint64_t)(at / UPB_FULL_TURN_MDEG);
        enter_frame(d, d->frame_base + turns > d->frame ? d->frame_base + turns : d->frame, 0);
        if (d->pushed == d->segment) { /* a stream that just began inserts nothing before its first column */
            d->counters.firings_skipped++;
            continue;
        }
        next_note(d, d->last_time_ns + (uint64_t)(time * i / gaps), azimuth_at(d, at), UPB_WIRE_INSERTED);
        frame_of(d, d->frame)->inserted++;
        d->counters.firings_inserted++;
        upb_stream_gap(d->stream, 1);
    }
    d->health.now.inserted += step->missing;
    daemon_event(d, UPB_EVENT_GAP, step->missing, 0, 0);
}

static int is_near(uint32_t azimuth_mdeg, uint32_t mark_mdeg) {
    const uint32_t apart = azimuth_mdeg > mark_mdeg ? azimuth_mdeg - mark_mdeg : mark_mdeg - azimuth_mdeg;
    return apart < FOV_MARGIN_MDEG || apart > UPB_FULL_TURN_MDEG - FOV_MARGIN_MDEG;
}

/* From the end of a limited field of view to its begin: nothing was to come between. */
static int is_blind_part(const upb_daemon *d, const upb_firing *firing) {
    const upb_daemon_config *c = &d->config;
    return c->fov_begin_mdeg != c->fov_end_mdeg && is_near(d->last_azimuth_mdeg, c->fov_end_mdeg) &&
           is_near(firing->azimuth_mdeg, c->fov_begin_mdeg);
}

static void note_jump(upb_daemon *d, upb_fault fault, uint32_t *count, uint64_t value) {
    ++*count;
    daemon_report(d, fault, UPB_MONITOR_FAILED, value);
}

/* How a firing follows the last one. */
typedef enum transition {
    FOLLOWS,   /* with firings to insert between, if some are missing */
    NEW_TURN,  /* the blind part of a limited field of view lies between */
    BROKEN_OFF /* what lies between is unknown, or too much to be inserted */
} transition;

static transition transition_to(upb_daemon *d, const upb_firing *firing, const upb_step *step) {
    const int clock = (step->flags & UPB_STEP_TIME_JUMP) != 0;
    const int jumped = (firing->flags & UPB_FIRING_JUMP) || (clock && step->missing);
    if ((jumped || step->missing) && is_blind_part(d, firing)) {
        d->fov_break = 2 * d->packet_firings;
        return NEW_TURN;
    }
    if (d->fov_break)
        d->fov_break--;
    else if (clock && !jumped) /* the azimuth goes on as if nothing were */
        note_jump(d, UPB_FAULT_SENSOR_TIME_JUMP, &d->health.now.jumps_time, firing->azimuth_mdeg);
    if (jumped)
        note_jump(d, UPB_FAULT_SENSOR_AZIMUTH_JUMP, &d->health.now.jumps_azimuth, firing->azimuth_mdeg);
    const int broken = jumped || (step->flags & UPB_STEP_RESTART) || step->missing > d->columns;
    if (!broken || !daemon_reacts(d, REACT_RESYNC))
        return FOLLOWS;
    d->counters.resyncs++;
    daemon_event(d, UPB_EVENT_RESYNC, jumped ? UPB_FAULT_SENSOR_AZIMUTH_JUMP : UPB_FAULT_NET_LOSS, 0, step->missing);
    return BROKEN_OFF;
}

static void watch_stuck(upb_daemon *d, const upb_step *step, const upb_firing *firing) {
    if (!(step->flags & UPB_STEP_STUCK)) {
        d->stuck_run = 0;
        return;
    }
    d->stuck_run++;
    d->stuck_azimuth_mdeg = firing->azimuth_mdeg;
    d->health.now.stuck++;
}

static void push(upb_daemon *d, const upb_firing *firing, const upb_firing *second, uint64_t received_ns) {
    firing_note *note = next_note(d, firing->time_ns, firing->azimuth_mdeg, second ? UPB_WIRE_SECOND : 0);
    if (second) {
        d->second_end = d->pushed;
        memcpy(note->second_distance, second->distance, sizeof note->second_distance);
        memcpy(note->second_intensity, second->intensity, sizeof note->second_intensity);
    }
    frame_of(d, d->frame)->received++;
    upb_ledger_input(&d->ledger, d->frame, received_ns);
    d->counters.firings_processed++;
    const uint32_t column = (uint32_t)((d->pushed - 1 - d->segment) % d->columns);
    upb_stream_push(d->stream, column, firing->distance, firing->intensity);
}

/* Number of the frame that the firing is of. Frames go up by one, or by more where turns were lost. */
static uint64_t number_of(upb_daemon *d, const upb_step *step, int new_segment) {
    uint64_t frame = d->frame_base + step->frame;
    const int had_frames = d->counters.firings_processed > 0;
    if (new_segment && had_frames && frame <= d->frame) { /* its frame was closed already */
        d->frame_base += d->frame + 1 - frame;
        frame = d->frame + 1;
    }
    if (!new_segment && frame < d->frame)
        return d->frame; /* never back */
    if (frame > d->frame + 1 && had_frames)
        d->counters.frames_skipped += frame - d->frame - 1;
    if (!new_segment && d->frame_column >= 2 * d->columns) {
        d->frame_base++;
        d->counters.frames_forced++;
        frame_of(d, d->frame)->partial = 1;
        return d->frame + 1;
    }
    return frame;
}

void daemon_take_firing(upb_daemon *d, const upb_firing *firing, const upb_firing *second, uint64_t received_ns) {
    const upb_step step = upb_azimuth_track(&d->tracker, firing);
    if (step.rpm_milli)
        d->rpm_milli = step.rpm_milli;
    watch_stuck(d, &step, firing);
    const transition how = d->stream ? transition_to(d, firing, &step) : BROKEN_OFF;
    if (how == NEW_TURN)
        daemon_health_look(d, !frame_of(d, d->frame)->partial);
    if (how != FOLLOWS)
        daemon_end_segment(d, how == BROKEN_OFF);
    const int new_segment = d->stream == NULL;
    if (new_segment) {
        if (how == BROKEN_OFF && !(step.flags & UPB_STEP_TIME_JUMP))
            d->counters.firings_skipped += step.missing;
        use_pending_model(d);
        daemon_begin_stream(d, first_columns(d, firing));
        if (!d->stream)
            return;
    } else if (step.missing && daemon_reacts(d, REACT_GAP))
        insert_missing(d, &step, firing->time_ns);
    enter_frame(d, number_of(d, &step, new_segment), new_segment && how == BROKEN_OFF);
    push(d, firing, second, received_ns);
    daemon_health_firing(d, firing);
    d->last_angle_mdeg = step.angle_mdeg;
    d->last_azimuth_mdeg = firing->azimuth_mdeg;
    d->last_time_ns = firing->time_ns;
}
