/* Raw columns to check kernels with: random ones and extremes. */
#ifndef UPB_TEST_COLUMNS_H
#define UPB_TEST_COLUMNS_H

#include "check.h"
#include "upbeam/upbeam.h"

typedef struct raw_column {
    uint16_t distance[UPB_BEAMS];
    uint8_t intensity[UPB_BEAMS];
} raw_column;

static const char *const patterns[] = {"scene",       "random", "sparse", "zero",   "max",
                                       "alternating", "single", "equal",  "limits", "extremes"};
enum { SCENE = 0, ALL_MAX = 4, ALL_EQUAL = 7, EXTREMES = 9, PATTERNS = sizeof patterns / sizeof patterns[0] };

/* Counts low..high are seen; 1 <= low <= high <= 65535. */
static uint16_t pattern_distance(random_source *random, unsigned pattern, uint32_t low, uint32_t high, unsigned k,
                                 unsigned chosen) {
    const uint16_t within = (uint16_t)(low + random_below(random, high - low + 1));
    switch (pattern) {
    case SCENE: /* smooth surfaces some steps apart, a return in ten missing */
        return random_below(random, 10) ? (uint16_t)(low + (high - low) / 2 + 40 * (k / 8) + random_below(random, 20))
                                        : 0;
    case 1:
        return within;
    case 2:
        return random_below(random, 3) ? 0 : within;
    case 3:
        return 0;
    case ALL_MAX:
        return 65535;
    case 5:
        return k % 2 ? (uint16_t)high : 0;
    case 6:
        return k == chosen % UPB_BEAMS ? within : 0;
    case ALL_EQUAL:
        return (uint16_t)(low + chosen % (high - low + 1));
    case EXTREMES: /* the largest differences there are */
        return (uint16_t)(random_below(random, 2) ? high : low);
    default: { /* just inside and just outside */
        const uint32_t near_limit[4] = {low - 1, low, high, high + 1};
        return (uint16_t)near_limit[random_below(random, 4)];
    }
    }
}

static void pattern_column(random_source *random, unsigned pattern, uint32_t low, uint32_t high, raw_column *column) {
    const unsigned chosen = random_u32(random);
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        column->distance[k] = pattern_distance(random, pattern, low, high, k, chosen);
        column->intensity[k] = (uint8_t)(pattern == ALL_MAX     ? 255
                                         : pattern == ALL_EQUAL ? chosen >> 8
                                         : pattern == EXTREMES  ? 255 * random_below(random, 2)
                                                                : random_below(random, 256));
    }
}

#endif /* UPB_TEST_COLUMNS_H */
