/* Times of the kernels, of streams around them, and of single columns. */
#define _POSIX_C_SOURCE 200112L
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

#include "bench.h"
#include "upb_internal.h"

enum { THREADS_MAX = 16, SPINS = 2000 };

typedef struct worker {
    bench_job *job;
    pthread_t thread;
    uint32_t first, end; /* its columns */
    _Alignas(UPB_ALIGN) atomic_uint done;
} worker;

struct bench_job {
    const upb_model *model;
    upb_kernels kernels;
    upb_precision precision;
    bench_work work;
    uint32_t columns, threads;
    uint16_t *distance; /* [columns][UPB_BEAMS], and the image [UPB_BEAMS][columns] behind it */
    uint8_t *intensity;
    uint16_t *out_distance; /* [columns][UPB_BEAMS], or the image [UPB_ROWS][columns] */
    uint8_t *out_intensity;
    void *stream_memory;
    upb_stream *stream;
    uint64_t sink_ns, sink_sum;
    worker workers[THREADS_MAX];
    _Alignas(UPB_ALIGN) atomic_uint go; /* the round that workers may start; UINT32_MAX: end */
};

/* -------------------------------------------------------------------------------------------------- kernels */

/* Columns first..end-1 from their counts, with the neighbours on both sides; as a stream does, each prepared once. */
static void run_f32(bench_job *job, uint32_t first, uint32_t end) {
    upb_prepared_f32 prepared[3];
    const upb_model_f32 *model = &job->model->f32;
    memset(&prepared[(first + 2) % 3], 0, sizeof prepared[0]);
    for (uint32_t c = first ? first - 1 : 0; c <= end; c++) {
        upb_prepared_f32 *last = &prepared[c % 3];
        if (c < job->columns)
            job->kernels.prepare_f32(last, model, job->distance + (size_t)c * UPB_BEAMS,
                                     job->intensity + (size_t)c * UPB_BEAMS);
        else
            memset(last, 0, sizeof *last);
        if (c <= first)
            continue;
        const size_t at = (size_t)(c - 1) * UPB_LANES;
        job->kernels.windows_f32(model, &prepared[(c + 1) % 3], &prepared[(c + 2) % 3], last, job->out_distance + at,
                                 job->out_intensity + at);
    }
}

static void run_int(bench_job *job, uint32_t first, uint32_t end) {
    upb_prepared_int prepared[3];
    const upb_model_int *model = upb_model_integer(job->model, job->precision);
    const upb_windows_int_fn windows =
        job->precision == UPB_PRECISION_INT16 ? job->kernels.windows_int16 : job->kernels.windows_int8;
    memset(&prepared[(first + 2) % 3], 0, sizeof prepared[0]);
    for (uint32_t c = first ? first - 1 : 0; c <= end; c++) {
        upb_prepared_int *last = &prepared[c % 3];
        if (c < job->columns)
            job->kernels.prepare_int(last, model, job->distance + (size_t)c * UPB_BEAMS,
                                     job->intensity + (size_t)c * UPB_BEAMS);
        else
            memset(last, 0, sizeof *last);
        if (c <= first)
            continue;
        const size_t at = (size_t)(c - 1) * UPB_LANES;
        windows(model, &prepared[(c + 1) % 3], &prepared[(c + 2) % 3], last, job->out_distance + at,
                job->out_intensity + at);
    }
}

static void run_kernels(bench_job *job, uint32_t first, uint32_t end) {
    if (job->precision == UPB_PRECISION_FP32)
        run_f32(job, first, end);
    else
        run_int(job, first, end);
}

/* -------------------------------------------------------------------------------------------------- threads */

/* Waits without sleeping, since waking takes longer than the work; other threads of a crowded core get their turn. */
static uint32_t wait_for_change(atomic_uint *value, uint32_t from) {
    uint32_t now;
    for (uint32_t spins = 0; (now = atomic_load_explicit(value, memory_order_acquire)) == from; spins++)
        if (spins > SPINS)
            sched_yield();
    return now;
}

static void *work_along(void *argument) {
    worker *w = argument;
    uint32_t round = 0;
    for (;;) {
        const uint32_t next = wait_for_change(&w->job->go, round);
        if (next == UINT32_MAX)
            return NULL;
        round = next;
        run_kernels(w->job, w->first, w->end);
        atomic_store_explicit(&w->done, round, memory_order_release);
    }
}

static uint32_t start_workers(bench_job *job) {
    uint32_t started = 1; /* the caller is the first */
    atomic_store(&job->go, 0);
    for (uint32_t t = 0; t < job->threads; t++) {
        worker *w = &job->workers[t];
        w->job = job;
        w->first = (uint32_t)((uint64_t)job->columns * t / job->threads);
        w->end = (uint32_t)((uint64_t)job->columns * (t + 1) / job->threads);
        atomic_store(&w->done, 0);
        if (t > 0 && pthread_create(&w->thread, NULL, work_along, w) == 0)
            started++;
    }
    return started;
}

static void time_kernels(bench_job *job, uint32_t repeats, uint64_t *ns) {
    const uint32_t started = start_workers(job);
    for (uint32_t i = 0; i < repeats; i++) {
        const uint64_t start = bench_now_ns();
        atomic_store_explicit(&job->go, i + 1, memory_order_release);
        run_kernels(job, job->workers[0].first, job->workers[0].end);
        for (uint32_t t = 1; t < started; t++)
            while (atomic_load_explicit(&job->workers[t].done, memory_order_acquire) != i + 1)
                wait_for_change(&job->workers[t].done, i);
        /* A thread that could not be made: its columns are done here, and cost what they cost. */
        for (uint32_t t = started; t < job->threads; t++)
            run_kernels(job, job->workers[t].first, job->workers[t].end);
        ns[i] = bench_now_ns() - start;
    }
    atomic_store_explicit(&job->go, UINT32_MAX, memory_order_release);
    for (uint32_t t = 1; t < started; t++)
        pthread_join(job->workers[t].thread, NULL);
}

/* -------------------------------------------------------------------------------------------------- streams */

static void take_column(void *user, const upb_column *column) {
    bench_job *job = user;
    job->sink_ns = bench_now_ns();
    job->sink_sum += column->distance[1];
}

/* As cheap as a sink can be: reading a clock in each would be a tenth of the time. */
static void sum_column(void *user, const upb_column *column) {
    bench_job *job = user;
    job->sink_sum += column->distance[1];
}

static void push_all(bench_job *job) {
    for (uint32_t c = 0; c < job->columns; c++)
        upb_stream_push(job->stream, c, job->distance + (size_t)c * UPB_BEAMS, job->intensity + (size_t)c * UPB_BEAMS);
}

static void run_frame(bench_job *job) {
    const size_t image = (size_t)job->columns * UPB_BEAMS;
    uint32_t written;
    upb_stream_frame(job->stream, job->distance + image, job->columns, job->intensity + image, job->columns,
                     job->out_distance, job->columns, job->out_intensity, job->columns, job->columns, &written);
}

void bench_job_time(bench_job *job, uint32_t repeats, uint64_t *ns) {
    if (job->work == BENCH_KERNELS) {
        time_kernels(job, repeats, ns);
        return;
    }
    for (uint32_t i = 0; i < repeats; i++) {
        const uint64_t start = bench_now_ns();
        if (job->work == BENCH_PUSH)
            push_all(job);
        else
            run_frame(job);
        ns[i] = bench_now_ns() - start;
    }
}

static uint64_t least_timer_ns(void) {
    uint64_t least = UINT64_MAX;
    for (int i = 0; i < 1000; i++) {
        const uint64_t start = bench_now_ns(), ns = bench_now_ns() - start;
        least = ns < least ? ns : least;
    }
    return least;
}

/* The stream with the sink that reads the clock. */
static upb_status make_stream(bench_job *job, upb_cpu cpu, upb_column_sink sink, upb_error *error) {
    upb_stream_config config = upb_stream_config_default();
    size_t bytes = 0;
    config.precision = job->precision;
    config.cpu = cpu;
    config.columns = job->columns;
    config.any_sensor = 1;
    config.aligned = 1;
    config.sink = sink;
    config.user = job;
    upb_status status = upb_stream_bytes(job->model, &config, &bytes, error);
    if (status != UPB_OK)
        return status;
    free(job->stream_memory);
    job->stream_memory = NULL;
    if (posix_memalign(&job->stream_memory, UPB_ALIGN, bytes))
        return UPB_E_SIZE;
    return upb_stream_init(job->stream_memory, bytes, job->model, &config, &job->stream, error);
}

void bench_job_latency(bench_job *job, uint64_t pushes, uint64_t interval_ns, upb_histogram *histogram,
                       uint64_t *timer_ns) {
    upb_stream_stats stats;
    upb_stream_get_stats(job->stream, &stats);
    upb_histogram_reset(histogram);
    *timer_ns = least_timer_ns();
    if (make_stream(job, (upb_cpu)stats.cpu, take_column, NULL) != UPB_OK)
        return;
    uint64_t due = bench_now_ns();
    for (uint64_t i = 0; i < pushes; i++) {
        const uint32_t c = (uint32_t)(i % job->columns);
        uint64_t start = bench_now_ns();
        for (; interval_ns && start < due;)
            start = bench_now_ns();
        /* After a stall of the machine go on from now: the columns missed would otherwise come without a pause. */
        due = (start > due + interval_ns ? start : due) + interval_ns;
        job->sink_ns = 0;
        upb_stream_push(job->stream, c, job->distance + (size_t)c * UPB_BEAMS, job->intensity + (size_t)c * UPB_BEAMS);
        if (job->sink_ns)
            upb_histogram_add(histogram, job->sink_ns - start);
    }
    make_stream(job, (upb_cpu)stats.cpu, sum_column, NULL);
}

/* ------------------------------------------------------------------------------------------------------ jobs */

static void *copy_with_image(const void *columns_in, uint32_t columns, size_t item) {
    const size_t count = (size_t)columns * UPB_BEAMS;
    unsigned char *copy = malloc(2 * count * item);
    if (!copy)
        return NULL;
    memcpy(copy, columns_in, count * item);
    for (size_t c = 0; c < columns; c++)
        for (size_t k = 0; k < UPB_BEAMS; k++)
            memcpy(copy + (count + k * columns + c) * item, copy + (c * UPB_BEAMS + k) * item, item);
    return copy;
}

static upb_status fill_job(bench_job *job, upb_cpu cpu, const uint16_t *distance, const uint8_t *intensity,
                           upb_error *error) {
    const size_t out = (size_t)job->columns * UPB_ROWS;
    job->distance = copy_with_image(distance, job->columns, sizeof *distance);
    job->intensity = copy_with_image(intensity, job->columns, sizeof *intensity);
    job->out_distance = calloc(out, sizeof *job->out_distance);
    job->out_intensity = calloc(out, sizeof *job->out_intensity);
    if (!job->distance || !job->intensity || !job->out_distance || !job->out_intensity)
        return UPB_E_SIZE;
    const upb_status status = make_stream(job, cpu, sum_column, error);
    if (status == UPB_OK)
        upb_kernels_select(&job->kernels, cpu);
    return status;
}

upb_status bench_job_make(const upb_model *model, upb_precision precision, upb_cpu cpu, bench_work work,
                          uint32_t threads, uint32_t columns, const uint16_t *distance, const uint8_t *intensity,
                          bench_job **made, upb_error *error) {
    void *memory = NULL;
    *made = NULL;
    if (threads < 1 || threads > THREADS_MAX || (threads > 1 && work != BENCH_KERNELS) || columns < 4 * threads)
        return UPB_E_ARGUMENT;
    if (posix_memalign(&memory, UPB_ALIGN, sizeof(bench_job)))
        return UPB_E_SIZE;
    bench_job *job = memory;
    memset(job, 0, sizeof *job);
    job->model = model;
    job->precision = precision;
    job->work = work;
    job->threads = threads;
    job->columns = columns;
    const upb_status status = fill_job(job, cpu, distance, intensity, error);
    if (status != UPB_OK)
        bench_job_free(job);
    else
        *made = job;
    return status;
}

void bench_job_free(bench_job *job) {
    if (!job)
        return;
    free(job->distance);
    free(job->intensity);
    free(job->out_distance);
    free(job->out_intensity);
    free(job->stream_memory);
    free(job);
}

const uint16_t *bench_job_distance(const bench_job *job) { return job->out_distance; }
const uint8_t *bench_job_intensity(const bench_job *job) { return job->out_intensity; }

void bench_time_call(void (*call)(void *), void *argument, uint32_t repeats, uint64_t *ns) {
    for (uint32_t i = 0; i < repeats; i++) {
        const uint64_t start = bench_now_ns();
        call(argument);
        ns[i] = bench_now_ns() - start;
    }
}
