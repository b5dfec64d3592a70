/* The tests' own few tools: checks that count, and random numbers that a seed repeats. */
#ifndef UPB_TEST_CHECK_H
#define UPB_TEST_CHECK_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static unsigned long check_count, check_failures;

static inline int check_that(int ok, const char *text, const char *file, int line) {
    check_count++;
    if (!ok && ++check_failures <= 20)
        fprintf(stderr, "%s:%d: failed: %s\n", file, line, text);
    return ok;
}

/* Counts a check; false if it failed. */
#define CHECK(condition) check_that(!!(condition), #condition, __FILE__, __LINE__)

static inline int check_equal(uint64_t got, uint64_t expected, const char *text, const char *file, int line) {
    int ok = check_that(got == expected, text, file, line);
    if (!ok && check_failures <= 20)
        fprintf(stderr, "    got %llu, expected %llu\n", (unsigned long long)got, (unsigned long long)expected);
    return ok;
}

#define CHECK_EQUAL(got, expected)                                                                                     \
    check_equal((uint64_t)(got), (uint64_t)(expected), #got " == " #expected, __FILE__, __LINE__)

/* The exit status of a test program. */
static inline int check_report(const char *name) {
    printf("%s: %lu checks, %lu failed\n", name, check_count, check_failures);
    return check_failures || !check_count;
}

/* xorshift64*: small, and the same everywhere. */
typedef struct random_source {
    uint64_t state;
} random_source;

static inline random_source random_seeded(uint64_t seed) {
    random_source source = {seed * 0x9e3779b97f4a7c15u + 0x2545f4914f6cdd1du};
    if (!source.state)
        source.state = 1;
    return source;
}

static inline uint32_t random_u32(random_source *source) {
    source->state ^= source->state >> 12;
    source->state ^= source->state << 25;
    source->state ^= source->state >> 27;
    return (uint32_t)(source->state * 0x2545f4914f6cdd1du >> 32);
}

/* 0 .. limit-1 */
static inline uint32_t random_below(random_source *source, uint32_t limit) {
    return (uint32_t)((uint64_t)random_u32(source) * limit >> 32);
}

/* -1 .. 1 */
static inline float random_signed(random_source *source) { return (float)random_u32(source) / 2147483648.0f - 1.0f; }

/* The value after `name` on the command line, or `otherwise`. */
static inline unsigned long option_number(int argc, char **argv, const char *name, unsigned long otherwise) {
    for (int i = 1; i + 1 < argc; i++)
        if (strcmp(argv[i], name) == 0)
            return strtoul(argv[i + 1], NULL, 0);
    return otherwise;
}

/* The text after `name` on the command line, or null. */
static inline const char *option_text(int argc, char **argv, const char *name) {
    for (int i = 1; i + 1 < argc; i++)
        if (strcmp(argv[i], name) == 0)
            return argv[i + 1];
    return NULL;
}

static inline int option_given(int argc, char **argv, const char *name) {
    for (int i = 1; i < argc; i++)
        if (strcmp(argv[i], name) == 0)
            return 1;
    return 0;
}

#endif /* UPB_TEST_CHECK_H */
