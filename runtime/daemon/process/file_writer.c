#define _GNU_SOURCE
#include "file_writer.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "network.h"

static int first_waiting(const file_writer *writer) {
    int slot = 0;
    while (slot < WRITER_SLOTS && !writer->waiting[slot].content)
        slot++;
    return slot;
}

static void *write_files(void *user) {
    file_writer *writer = user;
    pthread_mutex_lock(&writer->lock);
    for (;;) {
        const int slot = first_waiting(writer);
        if (slot == WRITER_SLOTS) {
            if (writer->end)
                break;
            pthread_cond_wait(&writer->changed, &writer->lock);
            continue;
        }
        char *const path = writer->waiting[slot].path;
        void *const content = writer->waiting[slot].content;
        const size_t bytes = writer->waiting[slot].bytes;
        writer->waiting[slot].content = NULL;
        pthread_mutex_unlock(&writer->lock);
        if (!file_replace(path, content, bytes))
            fprintf(stderr, "upbeamd: %s: %s\n", path, strerror(errno));
        free(path);
        free(content);
        pthread_mutex_lock(&writer->lock);
    }
    pthread_mutex_unlock(&writer->lock);
    return NULL;
}

int file_writer_start(file_writer *writer) {
    memset(writer, 0, sizeof *writer);
    pthread_mutex_init(&writer->lock, NULL);
    pthread_cond_init(&writer->changed, NULL);
    writer->started = pthread_create(&writer->thread, NULL, write_files, writer) == 0;
    return writer->started;
}

void file_writer_put(file_writer *writer, writer_slot slot, const char *path, void *content, size_t bytes) {
    char *const copy = strdup(path);
    if (!copy) {
        free(content);
        return;
    }
    pthread_mutex_lock(&writer->lock);
    if (writer->waiting[slot].content) {
        free(writer->waiting[slot].path);
        free(writer->waiting[slot].content);
    }
    writer->waiting[slot].path = copy;
    writer->waiting[slot].content = content;
    writer->waiting[slot].bytes = bytes;
    pthread_cond_signal(&writer->changed);
    pthread_mutex_unlock(&writer->lock);
}

void file_writer_end(file_writer *writer) {
    if (!writer->started)
        return;
    pthread_mutex_lock(&writer->lock);
    writer->end = 1;
    pthread_cond_signal(&writer->changed);
    pthread_mutex_unlock(&writer->lock);
    pthread_join(writer->thread, NULL);
    writer->started = 0;
}
