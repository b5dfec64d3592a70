/* The program text: a prelude with the model's numbers, then the kernel files. kernels/opencl/source.py writes the
 * same. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "upb_cl_internal.h"
#include "upb_cl_kernels.h" /* made by embed.cmake */

/* A text that grows. After a failed allocation `text` is null, and nothing more is added. */
typedef struct growing_text {
    char *text;
    size_t length, capacity;
} growing_text;

#if defined(__GNUC__)
__attribute__((format(printf, 2, 3)))
#endif
static void
add(growing_text *to, const char *format, ...) {
    va_list arguments;
    if (!to->text)
        return;
    if (to->capacity - to->length < 512) { /* far more than any format below gives */
        char *larger = realloc(to->text, to->capacity * 2);
        if (!larger)
            free(to->text);
        to->text = larger;
        to->capacity *= 2;
        if (!larger)
            return;
    }
    va_start(arguments, format);
    to->length += (size_t)vsnprintf(to->text + to->length, to->capacity - to->length, format, arguments);
    va_end(arguments);
}

static void add_file(growing_text *to, const char *text) {
    const size_t bytes = strlen(text);
    for (size_t at = 0; at < bytes; at += 400)
        add(to, "%.400s", text + at);
    add(to, "\n");
}

/* Exact, and without a decimal point, which is a comma in some locales. */
static void add_float(growing_text *to, float value) {
    int exponent;
    const float fraction = frexpf(value, &exponent);
    add(to, "%s0x%xp%df, ", value < 0 ? "-" : "", (unsigned)fabsf(ldexpf(fraction, 24)), exponent - 24);
}

static void add_int(growing_text *to, int32_t value) {
    if (value == INT32_MIN)
        add(to, "(-2147483647 - 1), ");
    else
        add(to, "%ld, ", (long)value);
}

static void add_limits(growing_text *to, const char *name, const uint16_t *row_max_count) {
    add(to, "#define %s {", name);
    for (unsigned k = 0; k < UPB_BEAMS; k++)
        add(to, "%u, ", (unsigned)row_max_count[2 * k]);
    add(to, "}\n");
}

static void add_rules(growing_text *to, const upb_model_info *info, const upb_cl_layout *layout) {
    add(to, "#define UPB_PAD %u\n#define UPB_STRIDE_IN %u\n#define UPB_STRIDE_OUT %u\n", (unsigned)layout->pad,
        (unsigned)layout->stride_in, (unsigned)layout->stride_out);
    add(to, "#define UPB_MIN_COUNT %u\n#define UPB_FILL %d\n#define UPB_REPEAT_LAST_ROW %d\n",
        (unsigned)info->min_count, info->empty_rule == UPB_EMPTY_FILL, info->last_row == UPB_LAST_ROW_REPEAT);
    add_limits(to, "UPB_SEEN_MAX", info->row_max_count);
    add_limits(to, "UPB_GIVEN_MAX", info->row_max_count + 1);
}

static void add_network_f32(growing_text *to, unsigned n, const upb_network_f32 *net) {
    add(to, "#define UPB_HIDDEN_%u %u\n#define UPB_SKIP_%u %d\n#define UPB_SLOPE_%u ", n, (unsigned)net->hidden, n,
        net->skip != 0.0f, n);
    add_float(to, net->slope);
    to->length -= to->text ? 2 : 0; /* the comma */
    add(to, "\n#define UPB_WEIGHTS_%u {", n);
    for (uint32_t h = 0; h < net->hidden; h++)
        for (int i = 0; i <= UPB_UNIT_OUTPUT; i++)
            add_float(to, net->unit[h][i]);
    add_float(to, net->offset);
    add(to, "}\n");
}

static void add_network_int(growing_text *to, unsigned n, const upb_network_int *net) {
    add(to, "#define UPB_HIDDEN_%u %u\n#define UPB_SKIP_%u %u\n#define UPB_SLOPE_%u %d\n", n, (unsigned)net->hidden, n,
        (unsigned)net->skip, n, (int)net->slope);
    add(to, "#define UPB_K_%u %u\n#define UPB_J_%u %u\n#define UPB_T_%u %u\n", n, (unsigned)net->k, n, (unsigned)net->j,
        n, (unsigned)net->t);
    add(to, "#define UPB_WEIGHTS_%u {", n);
    for (uint32_t h = 0; h < net->hidden; h++) {
        for (int i = 0; i <= UPB_TAP_MINIMUM; i++)
            add_int(to, net->weight[h][i]);
        add_int(to, net->bias[h]);
        add_int(to, net->output[h]);
    }
    add_int(to, net->offset);
    add(to, "}\n");
}

char *upb_cl_source(const upb_model *model, upb_precision precision, const upb_cl_layout *layout) {
    growing_text text = {malloc(1 << 16), 0, 1 << 16};
    const int is_float = precision == UPB_PRECISION_FP32;
    add_rules(&text, &model->info, layout);
    add(&text, "#define UPB_NUMBER %s\n#define UPB_BITS %d\n", is_float ? "float" : "int",
        precision == UPB_PRECISION_INT8 ? 8 : 16);
    for (unsigned n = 0; n < 2; n++) {
        if (is_float)
            add_network_f32(&text, n, &model->f32.network[n]);
        else
            add_network_int(&text, n, &upb_model_integer(model, precision)->network[n]);
    }
    add_file(&text, upb_cl_window_rules);
    add_file(&text, is_float ? upb_cl_window_f32 : upb_cl_window_int);
    add_file(&text, upb_cl_window_kernel);
    return text.text;
}
