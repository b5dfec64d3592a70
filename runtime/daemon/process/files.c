/* Files: what must survive a restart, models, the ledger, the status. */
#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "network.h"
#include "process.h"

/* ----------------------------------------------------------------------------------------- kept on disk */

static int store_path(const process *p, upb_store what, char *path, size_t bytes) {
    const char *name = what == UPB_STORE_FRESHNESS ? "freshness" : "faults";
    return snprintf(path, bytes, "%s/%s", p->settings.state, name) < (int)bytes;
}

upb_stored files_read_store(void *user, upb_store what, uint8_t *bytes, size_t count) {
    char path[4096];
    if (!store_path(user, what, path, sizeof path))
        return UPB_STORED_FAILED;
    FILE *file = fopen(path, "rb");
    if (!file)
        return errno == ENOENT ? UPB_STORED_NOTHING : UPB_STORED_FAILED;
    const int whole = fread(bytes, 1, count, file) == count && fgetc(file) == EOF;
    fclose(file);
    return whole ? UPB_STORED_DONE : UPB_STORED_FAILED;
}

/* The freshness counter must be on disk before the command it came with is carried out; the fault memory can follow. */
upb_stored files_write_store(void *user, upb_store what, const uint8_t *bytes, size_t count) {
    process *p = user;
    char path[4096];
    if (!store_path(user, what, path, sizeof path))
        return UPB_STORED_FAILED;
    void *const copy = what == UPB_STORE_FAULTS && p->writer.started ? malloc(count) : NULL;
    if (!copy)
        return file_replace(path, bytes, count) ? UPB_STORED_DONE : UPB_STORED_FAILED;
    memcpy(copy, bytes, count);
    file_writer_put(&p->writer, WRITE_FAULTS, path, copy, count);
    return UPB_STORED_DONE;
}

/* -------------------------------------------------------------------------------------------- the models */

int files_find_model(void *user, uint32_t crc32, const void **ubm, size_t *bytes) {
    process *p = user;
    for (size_t i = 0; i < p->model_count; i++) {
        const model_file *model = &p->models[i];
        uint32_t crc = 0;
        for (unsigned b = 0; model->bytes >= 4 && b < 4; b++) /* a model file ends with its checksum */
            crc |= (uint32_t)model->content[model->bytes - 4 + b] << 8 * b;
        if (model->bytes < 4 || crc != crc32)
            continue;
        *ubm = model->content;
        *bytes = model->bytes;
        return 1;
    }
    return 0;
}

void files_forget_models(process *p) {
    while (p->model_count)
        free(p->models[--p->model_count].content);
}

/* Read when the process begins and on SIGHUP: a command must not wait for a disk. */
void files_read_models(process *p) {
    char path[4096];
    files_forget_models(p);
    DIR *folder = p->settings.models[0] ? opendir(p->settings.models) : NULL;
    if (p->settings.models[0] && !folder)
        fprintf(stderr, "upbeamd: %s: %s\n", p->settings.models, strerror(errno));
    for (struct dirent *entry; folder && p->model_count < MODELS_MAX && (entry = readdir(folder));) {
        const char *end = strrchr(entry->d_name, '.');
        if (!end || strcmp(end, ".ubm") != 0 ||
            snprintf(path, sizeof path, "%s/%s", p->settings.models, entry->d_name) >= (int)sizeof path)
            continue;
        model_file *model = &p->models[p->model_count];
        model->content = file_read(path, MODELS_BYTES_MAX, &model->bytes);
        p->model_count += model->content != NULL;
    }
    if (folder)
        closedir(folder);
}

void files_print_error(const char *what, upb_status status, const upb_error *error) {
    fprintf(stderr, "upbeamd: %s: %s%s%s", what, error->what, error->what[0] ? ": " : "", upb_status_text(status));
    if (error->got || error->expected)
        fprintf(stderr, " (got %llu, expected %llu)", (unsigned long long)error->got,
                (unsigned long long)error->expected);
    fputc('\n', stderr);
}

void files_reload(process *p) {
    upb_error error;
    size_t bytes = 0;
    memset(&error, 0, sizeof error);
    files_read_models(p);
    uint8_t *ubm = file_read(p->settings.model, MODELS_BYTES_MAX, &bytes);
    static const uint8_t nothing[1];
    const upb_status status =
        upb_daemon_swap_model(p->daemon, ubm ? ubm : nothing, ubm ? bytes : 0, process_now(NULL), &error);
    if (status == UPB_OK)
        fprintf(stderr, "upbeamd: %s: in use from the next frame on\n", p->settings.model);
    else
        files_print_error(p->settings.model, status, &error);
    free(ubm);
}

/* --------------------------------------------------------------------------------------------- reporting */

void files_write_record(void *user, const upb_ledger_record *record) {
    process *p = user;
    if (!p->ledger)
        return;
    report_record(p->ledger, record);
    fputc('\n', p->ledger);
}

void files_write_event(void *user, const upb_event *event) {
    process *p = user;
    if (event->kind == UPB_EVENT_INTEGRITY && event->a == UPB_REGION_KEPT)
        p->reload_wanted = 1;
    if (!p->ledger)
        return;
    report_event(p->ledger, event);
    fputc('\n', p->ledger);
}

/* Text of malloc() that `write_to` prints; null without memory. */
static char *printed(void (*write_to)(FILE *to, void *user), void *user, size_t *bytes) {
    char *text = NULL;
    FILE *memory = open_memstream(&text, bytes);
    if (!memory)
        return NULL;
    write_to(memory, user);
    if (fclose(memory) == 0)
        return text;
    free(text);
    return NULL;
}

static void print_status(FILE *to, void *user) {
    process *p = user;
    report_status(to, p->daemon, &p->counts, p->at_end);
}

static void print_calibration(FILE *to, void *user) {
    report_calibration(to, upb_daemon_get_calibration(((process *)user)->daemon));
}

void files_write_status(process *p) {
    size_t bytes = 0;
    if (!p->settings.json[0])
        return;
    p->counts.receive_failed = atomic_load(&p->receive_failed);
    p->counts.positions_full = atomic_load(&p->positions_full);
    char *const text = printed(print_status, p, &bytes);
    if (text)
        file_writer_put(&p->writer, WRITE_STATUS, p->settings.json, text, bytes);
}

void files_write_calibration(process *p) {
    const uint32_t columns = upb_daemon_get_status(p->daemon).columns;
    size_t bytes = 0;
    if (!p->settings.calibration[0] || !upb_daemon_get_calibration(p->daemon) || columns == p->calibration_columns)
        return;
    p->calibration_columns = columns;
    char *const text = printed(print_calibration, p, &bytes);
    if (text)
        file_writer_put(&p->writer, WRITE_CALIBRATION, p->settings.calibration, text, bytes);
}
