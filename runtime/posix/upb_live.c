#define _GNU_SOURCE
#include "upb_live.h"

#include <errno.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#include "live_clock.h"
#include "live_consumer.h"
#include "live_pacer.h"
#include "live_ring.h"
#include "live_witness.h"

#define MAX_WITNESSES 16u
#define MAX_LISTED_DROPS 4096u
#define MAX_RING_PACKETS 65536u
#define MAX_FRAMES 100000000u
#define MAX_RATE_MILLIHERTZ 100000u

struct upb_live {
    upb_live_config config;
    live_clock clock;
    live_ring ring;
    live_consumer consumer;
    live_pacer pacer;
    live_witness *witnesses; /* [witness_count] */
    uint32_t witness_count;

    void *stream_memory;
    size_t stream_bytes;
    uint16_t *image_distance; /* [keep_count + 2][columns][UPB_ROWS] */
    uint8_t *image_intensity;
    uint64_t *slot_free_ns; /* virtual clock: [ring_packets], when the packet in a slot is done with */

    sem_t packets; /* posted for each packet put in, and at the end */
    uint32_t has_semaphore;
    uint32_t was_run;
    _Atomic int stop;        /* asked for */
    _Atomic int pacer_ended; /* no packet follows */
    _Atomic int witness_end; /* witnesses may go */
    uint32_t pacer_realtime, consumer_realtime, memory_locked;
    uint64_t pacer_cpu_ns, consumer_cpu_ns;
    uint64_t duration_ns;

    upb_live_stall *stalls; /* of all witnesses */
    upb_live_image *kept;
    upb_live_result result;
};

const char *upb_live_status_text(upb_live_status status) {
    switch (status) {
    case UPB_LIVE_OK:
        return "done";
    case UPB_LIVE_E_ARGUMENT:
        return "a value of the configuration is outside its range";
    case UPB_LIVE_E_LIBRARY:
        return "the stream could not be made";
    case UPB_LIVE_E_MEMORY:
        return "not enough memory";
    case UPB_LIVE_E_THREAD:
        return "a thread could not be started";
    case UPB_LIVE_E_STATE:
        return "a run can be started only once";
    }
    return "unknown status";
}

upb_live_config upb_live_config_default(void) {
    return (upb_live_config){
        .columns_per_packet = 12,
        .rate_millihertz = 20000,
        .deadline_ns = 50000000,
        .stream = upb_stream_config_default(),
        .ring_packets = 256,
        .wait = UPB_LIVE_WAIT_BLOCK,
        .poll_ns = 50000,
        .spin_ns = 50000,
        .lead_ns = 20000000,
        .witness = 1,
        .witness_period_ns = 1000000,
        .stall_threshold_ns = 2000000,
    };
}

/* ------------------------------------------------------------------------------------------------------- create */

typedef struct limit {
    const char *field;
    uint64_t value, least, most;
} limit;

static upb_live_status check_limits(const upb_live_config *c, upb_error *error) {
    const limit limits[] = {
        {"frames", c->frames, 1, UINT32_MAX},
        {"frames_total", c->frames_total, 0, MAX_FRAMES},
        {"columns", c->columns, 4, UPB_MAX_COLUMNS},
        {"columns_per_packet", c->columns_per_packet, 1, c->columns},
        {"rate_millihertz", c->rate_millihertz, 1, MAX_RATE_MILLIHERTZ},
        {"deadline_ns", c->deadline_ns, 1, UINT64_MAX},
        {"ring_packets", c->ring_packets, 2, MAX_RING_PACKETS},
        {"wait", c->wait, 0, UPB_LIVE_WAIT_POLL},
        {"witness_period_ns", c->witness_period_ns, 1, 1000000000},
        {"distance", c->distance != NULL, 1, 1},
        {"intensity", c->intensity != NULL, 1, 1},
        {"ring_packets", (c->ring_packets & (c->ring_packets - 1u)) == 0, 1, 1},
    };
    for (size_t i = 0; i < sizeof limits / sizeof limits[0]; i++) {
        if (limits[i].value < limits[i].least || limits[i].value > limits[i].most) {
            error->status = UPB_E_ARGUMENT;
            error->got = limits[i].value;
            error->expected = limits[i].value < limits[i].least ? limits[i].least : limits[i].most;
            strncpy(error->what, limits[i].field, sizeof error->what - 1);
            return UPB_LIVE_E_ARGUMENT;
        }
    }
    return UPB_LIVE_OK;
}

static upb_live_status make_stream(upb_live *live, const upb_model *model, upb_error *error) {
    upb_stream_config *config = &live->config.stream;
    config->columns = live->config.columns;
    config->sink = live_consumer_on_column;
    config->user = &live->consumer;

    if (upb_stream_bytes(model, config, &live->stream_bytes, error) != UPB_OK)
        return UPB_LIVE_E_LIBRARY;
    const size_t rounded = (live->stream_bytes + UPB_ALIGN - 1) / UPB_ALIGN * UPB_ALIGN;
    live->stream_memory = aligned_alloc(UPB_ALIGN, rounded);
    if (live->stream_memory == NULL)
        return UPB_LIVE_E_MEMORY;
    upb_stream *stream;
    if (upb_stream_init(live->stream_memory, rounded, model, config, &stream, error) != UPB_OK)
        return UPB_LIVE_E_LIBRARY;
    error->status = live_consumer_attach(&live->consumer, stream);
    return error->status == UPB_OK ? UPB_LIVE_OK : UPB_LIVE_E_LIBRARY;
}

static int make_images(upb_live *live) {
    const size_t count = live->config.keep_count + 2;
    const size_t pixels = (size_t)live->config.columns * UPB_ROWS;

    live->image_distance = calloc(count * pixels, sizeof *live->image_distance);
    live->image_intensity = calloc(count * pixels, sizeof *live->image_intensity);
    live->consumer.images = calloc(count, sizeof *live->consumer.images);
    live->kept = calloc(live->config.keep_count + 1, sizeof *live->kept);
    if (live->image_distance == NULL || live->image_intensity == NULL || live->consumer.images == NULL ||
        live->kept == NULL)
        return 0;
    for (size_t i = 0; i < count; i++) {
        live_image *image = &live->consumer.images[i];
        image->distance = live->image_distance + i * pixels;
        image->intensity = live->image_intensity + i * pixels;
        image->frame = i < live->config.keep_count ? live->config.keep_frames[i] : UINT64_MAX;
    }
    return 1;
}

static int make_witnesses(upb_live *live) {
    uint32_t cpus[MAX_WITNESSES];

    if (!live->config.witness || live->config.virtual_clock.enabled)
        return 1;
    live->witness_count = live_witness_cpus(cpus, MAX_WITNESSES);
    const uint32_t bound = live->witness_count;
    if (bound == 0)
        live->witness_count = 1;
    live->witnesses = calloc(live->witness_count, sizeof *live->witnesses);
    live->stalls = calloc((size_t)live->witness_count * LIVE_STALLS_PER_WITNESS, sizeof *live->stalls);
    if (live->witnesses == NULL || live->stalls == NULL)
        return 0;
    for (uint32_t i = 0; i < live->witness_count; i++) {
        live->witnesses[i].clock = &live->clock;
        live->witnesses[i].end = &live->witness_end;
        live->witnesses[i].period_ns = live->config.witness_period_ns;
        live->witnesses[i].threshold_ns = live->config.stall_threshold_ns;
        live->witnesses[i].cpu = bound > 0 ? cpus[i] : UINT32_MAX;
    }
    return 1;
}

static int make_lists(upb_live *live) {
    const size_t packet_pixels = (size_t)live->config.columns_per_packet * UPB_BEAMS;

    live->pacer.wrapped_distance = calloc(packet_pixels, sizeof *live->pacer.wrapped_distance);
    live->pacer.wrapped_intensity = calloc(packet_pixels, sizeof *live->pacer.wrapped_intensity);
    if (live->pacer.wrapped_distance == NULL || live->pacer.wrapped_intensity == NULL)
        return 0;
    live->consumer.frame_capacity = (size_t)live->consumer.frames_total;
    live->consumer.frames = calloc(live->consumer.frame_capacity, sizeof *live->consumer.frames);
    live->pacer.drop_capacity = MAX_LISTED_DROPS;
    live->pacer.drops = calloc(MAX_LISTED_DROPS, sizeof *live->pacer.drops);
    live->slot_free_ns = calloc(live->config.ring_packets, sizeof *live->slot_free_ns);
    return live->consumer.frames != NULL && live->pacer.drops != NULL && live->slot_free_ns != NULL;
}

static void connect_parts(upb_live *live) {
    live_consumer *c = &live->consumer;
    live_pacer *p = &live->pacer;
    const upb_clock clock = {.now_ns = live_clock_now, .user = &live->clock};

    live->clock.is_virtual = live->config.virtual_clock.enabled;
    c->config = p->config = &live->config;
    c->clock = p->clock = &live->clock;
    for (uint32_t i = 0; i < LIVE_OPEN_FRAMES; i++)
        c->received[i].frame = UINT64_MAX;
    p->columns_total = live->config.frames_total * live->config.columns;
    upb_histogram_reset(&c->column_compute);
    upb_histogram_reset(&c->packet_compute);
    upb_histogram_reset(&p->lateness);
    upb_ledger_init(&c->ledger, &c->ledger_last, 1, live->config.deadline_ns, clock);
}

upb_live_status upb_live_create(const upb_model *model, const upb_live_config *config, upb_live **live,
                                upb_error *error) {
    upb_error unread;
    upb_error *const e = error != NULL ? error : &unread;

    *live = NULL;
    memset(e, 0, sizeof *e);
    upb_live_status status = check_limits(config, e);
    if (status != UPB_LIVE_OK)
        return status;
    upb_live *l = aligned_alloc(SPSC_CACHE_LINE, sizeof *l); /* the ring's indices ask for it */
    if (l == NULL)
        return UPB_LIVE_E_MEMORY;
    memset(l, 0, sizeof *l);
    l->config = *config;
    if (l->config.frames_total == 0)
        l->config.frames_total = config->frames;
    connect_parts(l);
    status = make_stream(l, model, e);
    if (status == UPB_LIVE_OK && !(live_ring_init(&l->ring, config->ring_packets, config->columns_per_packet) &&
                                   make_images(l) && make_lists(l) && make_witnesses(l)))
        status = UPB_LIVE_E_MEMORY;
    if (status == UPB_LIVE_OK) {
        l->has_semaphore = sem_init(&l->packets, 0, 0) == 0;
        status = l->has_semaphore ? UPB_LIVE_OK : UPB_LIVE_E_THREAD;
    }
    if (status != UPB_LIVE_OK) {
        upb_live_destroy(l);
        return status;
    }
    *live = l;
    return UPB_LIVE_OK;
}

void upb_live_destroy(upb_live *live) {
    if (live == NULL)
        return;
    if (live->has_semaphore)
        sem_destroy(&live->packets);
    live_ring_free(&live->ring);
    free(live->stream_memory);
    free(live->image_distance);
    free(live->image_intensity);
    free(live->consumer.images);
    free(live->kept);
    free(live->witnesses);
    free(live->stalls);
    free(live->consumer.frames);
    free(live->pacer.drops);
    free(live->pacer.wrapped_distance);
    free(live->pacer.wrapped_intensity);
    free(live->slot_free_ns);
    free(live);
}

/* ---------------------------------------------------------------------------------------------------- real time */

static uint32_t ask_for_realtime(int priority) {
    const struct sched_param parameter = {.sched_priority = priority};
    return pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameter) == 0;
}

static void *pacer_thread(void *argument) {
    upb_live *live = argument;
    live_pacer *pacer = &live->pacer;
    live_packet packet;

    if (live->config.realtime)
        live->pacer_realtime = ask_for_realtime(50);
    live_thread_precise_timers();
    while (!atomic_load_explicit(&live->stop, memory_order_relaxed) && live_pacer_next(pacer, &packet)) {
        const uint64_t due = live_pacer_due_ns(pacer, packet.first_column);
        live_pacer_wait(pacer, due, &live->stop);
        if (atomic_load_explicit(&live->stop, memory_order_relaxed))
            break;
        packet.received_ns = live_clock_now(&live->clock);
        upb_histogram_add(&pacer->lateness, packet.received_ns - due);
        if (!live_pacer_drops(pacer, &packet)) {
            if (live_ring_put(&live->ring, &packet))
                sem_post(&live->packets);
            else
                live_pacer_overflowed(pacer, &packet);
        }
        live_pacer_played(pacer, &packet);
    }
    atomic_store_explicit(&live->pacer_ended, 1, memory_order_release);
    sem_post(&live->packets);
    live->pacer_cpu_ns = live_thread_cpu_ns();
    return NULL;
}

static void wait_for_packet(upb_live *live) {
    if (live->config.wait == UPB_LIVE_WAIT_BLOCK) {
        while (sem_wait(&live->packets) != 0 && errno == EINTR) {
        }
    } else if (live->config.poll_ns > 0) {
        live_clock_sleep(&live->clock, live_clock_now(&live->clock) + live->config.poll_ns);
    }
}

static void *consumer_thread(void *argument) {
    upb_live *live = argument;

    if (live->config.realtime)
        live->consumer_realtime = ask_for_realtime(49);
    live_thread_precise_timers();
    for (;;) {
        /* Before the look at the ring: a packet put in before the end is then seen. */
        const int ended = atomic_load_explicit(&live->pacer_ended, memory_order_acquire);
        const live_packet *packet = live_ring_peek(&live->ring);
        if (packet != NULL) {
            live_consumer_take(&live->consumer, packet);
            live_ring_release(&live->ring);
        } else if (ended) {
            break;
        } else {
            wait_for_packet(live);
        }
    }
    live_consumer_finish(&live->consumer, live->pacer.columns_played);
    live->consumer_cpu_ns = live_thread_cpu_ns();
    return NULL;
}

static upb_live_status run_threads(upb_live *live) {
    pthread_t pacer, consumer, witness[MAX_WITNESSES];
    uint32_t witnesses = 0;
    int failed = 0;

    while (witnesses < live->witness_count && !failed) {
        failed = pthread_create(&witness[witnesses], NULL, live_witness_run, &live->witnesses[witnesses]) != 0;
        witnesses += !failed;
    }
    const int has_consumer = !failed && pthread_create(&consumer, NULL, consumer_thread, live) == 0;
    const int has_pacer = has_consumer && pthread_create(&pacer, NULL, pacer_thread, live) == 0;
    if (has_pacer) {
        pthread_join(pacer, NULL);
    } else {
        atomic_store(&live->pacer_ended, 1);
        sem_post(&live->packets);
    }
    if (has_consumer)
        pthread_join(consumer, NULL);
    atomic_store(&live->witness_end, 1);
    for (uint32_t i = 0; i < witnesses; i++)
        pthread_join(witness[i], NULL);
    return has_pacer ? UPB_LIVE_OK : UPB_LIVE_E_THREAD;
}

static upb_live_status run_real(upb_live *live) {
    if (live->config.lock_memory)
        live->memory_locked = mlockall(MCL_CURRENT) == 0;
    live->clock.origin_ns = live_monotonic_ns();
    const upb_live_status status = run_threads(live);
    live->duration_ns = live_clock_now(&live->clock);
    if (live->memory_locked)
        munlockall();
    return status;
}

/* ------------------------------------------------------------------------------------------------ virtual clock */

/* Sets the clock to the start of the packet's service; returns when the service will have ended. */
static uint64_t begin_service(live_clock *clock, const upb_live_virtual *model, const live_packet *packet,
                              uint64_t previous_end) {
    clock->start_ns = packet->received_ns > previous_end ? packet->received_ns : previous_end;
    if (model->service_count > 0) {
        clock->fixed_ns = 0;
        clock->spread_ns = model->service_ns[packet->sequence % model->service_count];
    } else {
        clock->fixed_ns = model->packet_service_ns;
        clock->spread_ns = model->column_service_ns * packet->columns;
    }
    clock->now_ns = clock->start_ns;
    return clock->start_ns + clock->fixed_ns + clock->spread_ns;
}

/*
 * One packet after the other: what a packet meets depends on earlier ones alone, so it can be served as soon as it has
 * arrived. A slot of the ring is free again when its packet's service has ended. The flush at the end takes no time.
 */
static void run_virtual(upb_live *live) {
    const upb_live_virtual *model = &live->config.virtual_clock;
    uint64_t arrival = 0, end = 0, put = 0;
    live_packet packet;

    while (!atomic_load_explicit(&live->stop, memory_order_relaxed) && live_pacer_next(&live->pacer, &packet)) {
        const uint64_t due = live_pacer_due_ns(&live->pacer, packet.first_column);
        const uint64_t jitter = model->jitter_count ? model->jitter_ns[packet.sequence % model->jitter_count] : 0;
        uint64_t *slot = &live->slot_free_ns[put % live->config.ring_packets];
        arrival = due + jitter > arrival ? due + jitter : arrival;
        packet.received_ns = arrival;
        upb_histogram_add(&live->pacer.lateness, arrival - due);
        if (!live_pacer_drops(&live->pacer, &packet)) {
            if (*slot <= arrival) {
                end = begin_service(&live->clock, model, &packet, end);
                live_consumer_take(&live->consumer, &packet);
                *slot = end;
                put++;
            } else {
                live_pacer_overflowed(&live->pacer, &packet);
            }
        }
        live_pacer_played(&live->pacer, &packet);
    }
    live->clock.now_ns = end;
    live_consumer_finish(&live->consumer, live->pacer.columns_played);
    live->duration_ns = arrival > end ? arrival : end;
}

/* ------------------------------------------------------------------------------------------------------- result */

static void gather_stalls(upb_live *live) {
    upb_live_result *r = &live->result;

    for (uint32_t i = 0; i < live->witness_count; i++) {
        const live_witness *w = &live->witnesses[i];
        memcpy(live->stalls + r->stall_count, w->stalls, w->count * sizeof *w->stalls);
        r->stall_count += w->count;
        r->stalls_unlisted += w->unlisted;
        r->witnesses_bound += w->bound;
    }
    r->witnesses = live->witness_count;
    live_witness_sort(live->stalls, r->stall_count);
    r->stalls = live->stalls;
}

static void judge_misses(upb_live *live) {
    for (size_t i = 0; i < live->consumer.frame_count; i++) {
        upb_live_frame *f = &live->consumer.frames[i];
        if (f->record.verdict == (uint32_t)UPB_VERDICT_MISSED &&
            upb_live_explains(live->stalls, live->result.stall_count, f->record.last_input_ns, f->record.output_ns,
                              live->config.deadline_ns))
            f->flags |= UPB_LIVE_EXPLAINED;
    }
}

static upb_live_image show_image(const live_image *image) {
    return (upb_live_image){.frame = image->frame,
                            .columns_out = image->columns_out,
                            .reserved = 0,
                            .distance = image->distance,
                            .intensity = image->intensity};
}

static void gather_consumer(upb_live *live) {
    const live_consumer *c = &live->consumer;
    upb_live_result *r = &live->result;

    r->frames = c->frames;
    r->frame_count = c->frame_count;
    r->missed = c->ledger.missed;
    r->partial = c->ledger.partial;
    r->met = c->ledger.closed - c->ledger.missed - c->ledger.partial;
    r->frames_empty = c->frames_empty;
    r->packets_taken = c->packets_taken;
    r->columns_taken = c->columns_taken;
    r->columns_out = c->columns_out;
    r->columns_incomplete = c->columns_incomplete;
    r->columns_refused = c->columns_refused;
    r->latency = c->ledger.latency;
    r->column_compute = c->column_compute;
    r->packet_compute = c->packet_compute;
    for (size_t i = 0; i < live->config.keep_count; i++)
        live->kept[i] = show_image(&c->images[i]);
    r->kept = live->kept;
    r->kept_count = live->config.keep_count;
    if (c->last != NULL)
        r->last = show_image(c->last);
}

static void gather_pacer(upb_live *live) {
    const live_pacer *p = &live->pacer;
    upb_live_result *r = &live->result;

    r->packets_played = atomic_load(&p->shown_packets);
    r->columns_played = p->columns_played;
    r->columns_missing = p->columns_played - live->consumer.columns_taken;
    if (p->columns_played > 0)
        r->frames_begun = (p->columns_played + live->consumer.shift - 1) / live->config.columns + 1;
    r->dropped_fault = p->dropped_fault;
    r->dropped_overflow = p->dropped_overflow;
    r->drops = p->drops;
    r->drop_count = p->drop_count;
    r->drops_unlisted = p->drops_unlisted;
    r->pacer_lateness = p->lateness;
}

static void gather(upb_live *live) {
    upb_live_result *r = &live->result;
    upb_stream_stats stats;

    upb_stream_get_stats(live->consumer.stream, &stats);
    r->cpu = stats.cpu;
    r->delay_columns = stats.delay_columns;
    r->state_bytes = stats.state_bytes;
    r->stream_bytes = live->stream_bytes;
    r->stopped = atomic_load(&live->stop) != 0;
    r->realtime_granted = live->pacer_realtime && live->consumer_realtime;
    r->memory_locked = live->memory_locked;
    r->duration_ns = live->duration_ns;
    r->consumer_cpu_ns = live->consumer_cpu_ns;
    r->pacer_cpu_ns = live->pacer_cpu_ns;
    gather_consumer(live);
    gather_pacer(live);
    gather_stalls(live);
    judge_misses(live);
}

upb_live_status upb_live_run(upb_live *live) {
    upb_live_status status = UPB_LIVE_OK;

    if (live->was_run)
        return UPB_LIVE_E_STATE;
    live->was_run = 1;
    if (live->config.virtual_clock.enabled)
        run_virtual(live);
    else
        status = run_real(live);
    gather(live);
    return status;
}

void upb_live_stop(upb_live *live) { atomic_store(&live->stop, 1); }

upb_live_progress upb_live_get_progress(const upb_live *live) {
    const live_consumer *c = &live->consumer;
    const live_pacer *p = &live->pacer;
    return (upb_live_progress){
        .frames = atomic_load_explicit(&c->shown_frames, memory_order_relaxed),
        .missed = atomic_load_explicit(&c->shown_missed, memory_order_relaxed),
        .last_latency_ns = atomic_load_explicit(&c->shown_last_ns, memory_order_relaxed),
        .max_latency_ns = atomic_load_explicit(&c->shown_max_ns, memory_order_relaxed),
        .packets_played = atomic_load_explicit(&p->shown_packets, memory_order_relaxed),
        .packets_dropped = atomic_load_explicit(&p->shown_dropped, memory_order_relaxed),
    };
}

const upb_live_result *upb_live_get_result(const upb_live *live) { return &live->result; }
