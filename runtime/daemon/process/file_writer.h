/* A thread that writes small files, so that the working thread never waits for a disk. The latest content wins. */
#ifndef UPBEAMD_FILE_WRITER_H
#define UPBEAMD_FILE_WRITER_H

#include <pthread.h>
#include <stddef.h>

typedef enum writer_slot { WRITE_STATUS, WRITE_CALIBRATION, WRITE_FAULTS, WRITER_SLOTS } writer_slot;

typedef struct file_writer {
    pthread_t thread;
    pthread_mutex_t lock;
    pthread_cond_t changed;
    int end, started;
    struct {
        char *path;
        void *content; /* null: nothing waits */
        size_t bytes;
    } waiting[WRITER_SLOTS];
} file_writer;

/* 0: no thread. */
int file_writer_start(file_writer *writer);
/* Takes `content`, of malloc(). What waited in the slot is forgotten. */
void file_writer_put(file_writer *writer, writer_slot slot, const char *path, void *content, size_t bytes);
/* Writes what waits, then ends the thread. */
void file_writer_end(file_writer *writer);

#endif /* UPBEAMD_FILE_WRITER_H */
