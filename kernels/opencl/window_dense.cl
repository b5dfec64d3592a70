/*
 * The networks as they were trained (section DENS of docs/model-format.md), one work-item a window, layer by layer:
 * what to read first, and what the fast kernels are compared with. OpenCL C 1.2; the prelude is that of
 * window_rules.cl, and of each network: widths, input and output kind, scale, slope and one table of its weights.
 */
#define UPB_BEAMS 32
#define UPB_PAIRS 31

__constant ushort seen_max[UPB_BEAMS] = UPB_SEEN_MAX;
__constant ushort given_max[UPB_BEAMS] = UPB_GIVEN_MAX;
__constant float weights_0[] = UPB_WEIGHTS_0;
__constant float weights_1[] = UPB_WEIGHTS_1;

/* One network. `unit` is the size of what the images count, in what the network was trained on. */
typedef struct dense {
    int conv1, conv2, hidden;
    int takes_differences; /* the convolutions see pixels less the window's minimum */
    int adds_minimum;      /* to the output */
    float scale, slope, unit;
    __constant float *weights;
} dense;

static inline int is_seen(__global const ushort *distance, int beam, int column) {
    const ushort count = distance[(size_t)beam * UPB_STRIDE_IN + UPB_PAD + column];
    return count >= UPB_MIN_COUNT && count <= seen_max[beam];
}

/*
 * The six pixels of the window around (pair, column), its empty ones filled. `image` is the distance or the intensity;
 * which pixels are empty is told by the distance. Returns 0 for a window without any return.
 */
#define DEFINE_GATHER(name, type)                                                                                      \
    static inline int name(float *x, __global const ushort *distance, __global const type *image, int pair,            \
                           int column) {                                                                               \
        int seen[2][3], any[3];                                                                                        \
        float pixel[2][3];                                                                                             \
        for (int c = 0; c < 3; c++) {                                                                                  \
            for (int row = 0; row < 2; row++) {                                                                        \
                const size_t at = (size_t)(pair + row) * UPB_STRIDE_IN + UPB_PAD + column + c - 1;                     \
                seen[row][c] = is_seen(distance, pair + row, column + c - 1);                                          \
                pixel[row][c] = seen[row][c] ? (float)image[at] : 0.0f;                                                \
            }                                                                                                          \
            any[c] = seen[0][c] || seen[1][c];                                                                         \
        }                                                                                                              \
        for (int row = 0; row < 2; row++) {                                                                            \
            float column_of[3];                                                                                        \
            for (int c = 0; c < 3; c++)                                                                                \
                column_of[c] = UPB_FILL && !seen[row][c] ? pixel[1 - row][c] : pixel[row][c];                          \
            fill_columns(x + 3 * row, column_of, any);                                                                 \
        }                                                                                                              \
        return any[0] || any[1] || any[2];                                                                             \
    }

/* An empty column takes its neighbours' values. */
static inline void fill_columns(float *x, const float *column_of, const int *any) {
    const float left = column_of[0], middle = column_of[1], right = column_of[2];
    const float between = any[0] && any[2] ? min(left, right) : any[0] ? left : right;
    x[0] = !UPB_FILL || any[0] ? left : any[1] ? middle : right;
    x[1] = !UPB_FILL || any[1] ? middle : between;
    x[2] = !UPB_FILL || any[2] ? right : any[1] ? middle : left;
}

DEFINE_GATHER(gather_distance, ushort)
DEFINE_GATHER(gather_intensity, uchar)

/* A network's whole output, in what the image counts. */
static inline float dense_output(const dense *net, const float *x) {
    __constant float *conv1_weight = net->weights, *conv1_bias = conv1_weight + net->conv1;
    __constant float *conv2_weight = conv1_bias + net->conv1, *conv2_bias = conv2_weight + net->conv2 * net->conv1;
    __constant float *linear_1_weight = conv2_bias + net->conv2;
    __constant float *linear_1_bias = linear_1_weight + net->hidden * (6 * net->conv2 + 1);
    __constant float *linear_2_weight = linear_1_bias + net->hidden, *linear_2_bias = linear_2_weight + net->hidden;

    float least = x[0];
    for (int i = 1; i < 6; i++)
        least = min(least, x[i]);
    const float to_network = net->unit * net->scale, minimum = least * to_network;

    float features[6 * UPB_CONV2_MAX + 1]; /* channel by channel, then the minimum */
    for (int i = 0; i < 6; i++) {
        const float pixel = (net->takes_differences ? x[i] - least : x[i]) * to_network;
        for (int c2 = 0; c2 < net->conv2; c2++) {
            float sum = conv2_bias[c2];
            for (int c1 = 0; c1 < net->conv1; c1++)
                sum += conv2_weight[c2 * net->conv1 + c1] * (conv1_weight[c1] * pixel + conv1_bias[c1]);
            features[c2 * 6 + i] = sum;
        }
    }
    features[6 * net->conv2] = minimum;

    float y = linear_2_bias[0];
    for (int h = 0; h < net->hidden; h++) {
        float sum = linear_1_bias[h];
        for (int f = 0; f < 6 * net->conv2 + 1; f++)
            sum += linear_1_weight[h * (6 * net->conv2 + 1) + f] * features[f];
        y += linear_2_weight[h] * (sum > 0.0f ? sum : net->slope * sum);
    }
    /* What is added to the minimum is rounded before: the minimum is whole. */
    return net->adds_minimum ? floor(y / to_network + 0.5f) + least : floor(y / to_network + 0.5f);
}

/* Input and output are a distance image and behind it an intensity image. */
__kernel void upsample_image(__global const uchar *restrict input, __global uchar *restrict output) {
    __global const ushort *distance = (__global const ushort *)input;
    __global const uchar *intensity = input + 2 * UPB_BEAMS * UPB_STRIDE_IN;
    __global ushort *out_distance = (__global ushort *)output;
    __global uchar *out_intensity = output + 4 * UPB_BEAMS * UPB_STRIDE_OUT;
    const int column = get_global_id(0), pair = get_global_id(1);
    const dense networks[2] = {UPB_DENSE_0, UPB_DENSE_1};
    const size_t from = (size_t)pair * UPB_STRIDE_IN + UPB_PAD + column,
                 to = (size_t)2 * pair * UPB_STRIDE_OUT + column;
    float x[6];

    const int any = gather_distance(x, distance, distance, pair, column);
    const float count = dense_output(&networks[0], x);
    const int is_given = (UPB_FILL ? any : 1) && count >= UPB_MIN_COUNT && count <= given_max[pair];
    gather_intensity(x, distance, intensity, pair, column);
    const float grey = min(max(dense_output(&networks[1], x), 0.0f), 255.0f);

    out_distance[to] = distance[from]; /* the sensor's own row, to the bit */
    out_intensity[to] = intensity[from];
    out_distance[to + UPB_STRIDE_OUT] = is_given ? (ushort)count : 0;
    out_intensity[to + UPB_STRIDE_OUT] = is_given ? (uchar)grey : 0;
    if (pair == UPB_PAIRS - 1) { /* the last beam, and the row below it */
        for (int row = 2; row < 4; row++) {
            const int is_copied = row == 2 || UPB_REPEAT_LAST_ROW;
            out_distance[to + row * UPB_STRIDE_OUT] = is_copied ? distance[from + UPB_STRIDE_IN] : 0;
            out_intensity[to + row * UPB_STRIDE_OUT] = is_copied ? intensity[from + UPB_STRIDE_IN] : 0;
        }
    }
}
