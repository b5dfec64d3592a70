#include "report.h"

#include <inttypes.h>

static const char *const verdicts[] = {"met", "missed", "partial"};
static const char *const modes[UPB_MODES] = {"network", "valid_mean", "repeat", "pass_through"};

#define MODE_NAME(mode) ((mode) < UPB_MODES ? modes[mode] : "?")
#define VERDICT_NAME(verdict) ((verdict) < 3 ? verdicts[verdict] : "?")

void report_record(FILE *to, const upb_ledger_record *r) {
    fprintf(to,
            "{\"frame\": %" PRIu64 ", \"first_input_ns\": %" PRIu64 ", \"last_input_ns\": %" PRIu64
            ", \"output_ns\": %" PRIu64 ", \"latency_ns\": %" PRIu64
            ", \"verdict\": \"%s\", \"missing_columns\": %u, \"mode\": \"%s\"}",
            r->frame, r->first_input_ns, r->last_input_ns, r->output_ns, r->latency_ns, VERDICT_NAME(r->verdict),
            r->missing_columns, MODE_NAME(r->mode));
}

void report_event(FILE *to, const upb_event *e) {
    fprintf(to, "{\"event\": \"%s\", \"time_ns\": %" PRIu64 ", \"frame\": %" PRIu64, upb_event_name(e->kind),
            e->time_ns, e->frame);
    if (e->kind == UPB_EVENT_MODE)
        fprintf(to, ", \"from\": \"%s\", \"to\": \"%s\", \"lag_ns\": %" PRIu64, MODE_NAME(e->a), MODE_NAME(e->b),
                e->value);
    else if (e->kind == UPB_EVENT_FAULT_SET || e->kind == UPB_EVENT_FAULT_CLEARED || e->kind == UPB_EVENT_RESYNC)
        fprintf(to, ", \"fault\": \"%s\", \"value\": %" PRIu64, upb_fault_name(e->a), e->value);
    else
        fprintf(to, ", \"a\": %u, \"b\": %u, \"value\": %" PRIu64, e->a, e->b, e->value);
    fputc('}', to);
}

static void report_faults(FILE *to, const char *name, uint64_t faults) {
    const char *separator = "";
    fprintf(to, "  \"%s\": [", name);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++) {
        if (!(faults >> (id - 1) & 1))
            continue;
        fprintf(to, "%s\"%s\"", separator, upb_fault_name(id));
        separator = ", ";
    }
    fputs("],\n", to);
}

static void report_counters(FILE *to, const upb_daemon_counters *c) {
    const struct {
        const char *name;
        uint64_t value;
    } counters[] = {
        {"packets_received", c->packets_received},
        {"packets_processed", c->packets_processed},
        {"firings_processed", c->firings_processed},
        {"firings_inserted", c->firings_inserted},
        {"firings_skipped", c->firings_skipped},
        {"columns_out", c->columns_out},
        {"columns_lost", c->columns_lost},
        {"column_datagrams", c->column_datagrams},
        {"hdl64_packets", c->hdl64_packets},
        {"hdl64_beyond_range", c->hdl64_beyond_range},
        {"hdl64_padding", c->hdl64_padding},
        {"second_returns", c->second_returns},
        {"frames_closed", c->frames_closed},
        {"frames_missed", c->frames_missed},
        {"frames_partial", c->frames_partial},
        {"frames_forced", c->frames_forced},
        {"frames_skipped", c->frames_skipped},
        {"mode_changes", c->mode_changes},
        {"positions_received", c->positions_received},
        {"positions_malformed", c->positions_malformed},
        {"can_received", c->can_received},
        {"can_sent", c->can_sent},
        {"serial_received", c->serial_received},
        {"serial_sent", c->serial_sent},
        {"commands_accepted", c->commands_accepted},
        {"commands_rejected", c->commands_rejected},
        {"models_swapped", c->models_swapped},
        {"models_rejected", c->models_rejected},
        {"streams_made", c->streams_made},
        {"resyncs", c->resyncs},
        {"integrity_checks", c->integrity_checks},
        {"integrity_failures", c->integrity_failures},
        {"integrity_repairs", c->integrity_repairs},
        {"events", c->events},
    };
    fputs("  \"counters\": {\n", to);
    for (size_t i = 0; i < sizeof counters / sizeof counters[0]; i++)
        fprintf(to, "    \"%s\": %" PRIu64 ",\n", counters[i].name, counters[i].value);
    fputs("    \"packets_dropped\": {", to);
    for (uint32_t i = 0; i < UPB_DROPS; i++)
        fprintf(to, "%s\"%s\": %" PRIu64, i ? ", " : "", upb_drop_name(i), c->packets_dropped[i]);
    fputs("},\n    \"columns_by_mode\": {", to);
    for (uint32_t i = 0; i < UPB_MODES; i++)
        fprintf(to, "%s\"%s\": %" PRIu64, i ? ", " : "", modes[i], c->columns_by_mode[i]);
    fputs("}\n  },\n", to);
}

static void report_process(FILE *to, const process_counts *p) {
    fprintf(to,
            "  \"process\": {\"send_failed\": %" PRIu64 ", \"receive_failed\": %" PRIu64
            ", \"positions_full\": %" PRIu64 ", \"reloads\": %" PRIu64 ", \"can_failed\": %" PRIu64
            ", \"receive_buffer\": %u, \"real_time\": %u, \"pinned\": %u},\n",
            p->send_failed, p->receive_failed, p->positions_full, p->reloads, p->can_failed, p->receive_buffer,
            p->real_time, p->pinned);
}

static void report_latency(FILE *to, const upb_histogram *h) {
    fprintf(to,
            "  \"latency_ms\": {\"count\": %" PRIu64 ", \"p50\": %.6f, \"p99\": %.6f, \"p999\": %.6f, \"max\": %.6f}",
            h->count, (double)upb_histogram_quantile(h, 500000) / 1e6, (double)upb_histogram_quantile(h, 990000) / 1e6,
            (double)upb_histogram_quantile(h, 999000) / 1e6, (double)h->max_ns / 1e6);
}

static void report_ledger(FILE *to, const upb_ledger *ledger) {
    const uint64_t kept = ledger->closed < ledger->capacity ? ledger->closed : ledger->capacity;
    fputs(",\n  \"ledger\": [", to);
    for (uint64_t i = ledger->closed - kept; i < ledger->closed; i++) {
        fputs(i > ledger->closed - kept ? ",\n    " : "\n    ", to);
        report_record(to, &ledger->records[i % ledger->capacity]);
    }
    fputs("\n  ]", to);
}

void report_status(FILE *to, const upb_daemon *daemon, const process_counts *process, int with_ledger) {
    const upb_daemon_status s = upb_daemon_get_status(daemon);
    const upb_ledger *ledger = upb_daemon_get_ledger(daemon);
    fprintf(to,
            "{\n  \"version\": \"%s\",\n  \"now_ns\": %" PRIu64 ",\n  \"frame\": %" PRIu64 ",\n  \"mode\": \"%s\",\n"
            "  \"columns\": %u,\n  \"delay_columns\": %u,\n  \"rpm\": %.3f,\n  \"drift_ppm\": %d,\n"
            "  \"model_crc32\": %u,\n  \"returns_permille\": %u,\n  \"lag_ms\": %.6f,\n  \"lag_max_ms\": %.6f,\n"
            "  \"service_ms\": %.6f,\n  \"integrity_period_frames\": %u,\n  \"deadline_ms\": %.6f,\n"
            "  \"ended\": %s,\n",
            upb_version(), s.now_ns, s.frame, MODE_NAME(s.mode), s.columns, s.delay_columns, s.rpm_milli / 1e3,
            s.drift_ppm, s.model_crc32, s.returns_permille, (double)s.lag_ns / 1e6, (double)s.lag_max_ns / 1e6,
            (double)s.service_ns / 1e6, s.integrity_period_frames, (double)ledger->deadline_ns / 1e6,
            s.ended ? "true" : "false");
    report_faults(to, "faults", s.faults);
    report_faults(to, "faults_ever", s.faults_ever);
    report_counters(to, &s.counters);
    report_process(to, process);
    report_latency(to, &ledger->latency);
    if (with_ledger)
        report_ledger(to, ledger);
    fputs("\n}\n", to);
}

void report_calibration(FILE *to, const upb_packet_calibration *c) {
    const double degrees = 3.14159265358979323846 / 180.0;
    fputs("lasers:\n", to);
    for (uint32_t laser = 0; laser < c->beams; laser++) {
        uint32_t row = 0;
        while (row + 1 < c->beams && c->laser[row].laser_id != laser)
            row++;
        fprintf(to,
                "- {laser_id: %u, rot_correction: %.9f, vert_correction: %.9f, dist_correction: 0.0, "
                "dist_correction_x: 0.0, dist_correction_y: 0.0, vert_offset_correction: 0.0, "
                "horiz_offset_correction: 0.0, focal_distance: 0.0, focal_slope: 0.0, min_intensity: 0, "
                "max_intensity: 255}\n",
                laser, -c->laser[row].azimuth_offset_mdeg / 1e3 * degrees,
                c->laser[row].elevation_mdeg / 1e3 * degrees);
    }
    fprintf(to, "num_lasers: %u\ndistance_resolution: 0.002\n", c->beams);
}
