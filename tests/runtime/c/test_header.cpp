// The public header in C++11: every call has C linkage, and a stream runs from C++.
#include "upbeam/upbeam.h"

#include "check.h"

static void on_column(void *user, const upb_column *column) {
    *static_cast<unsigned *>(user) += column->flags & UPB_COLUMN_LAST;
}

int main() {
    alignas(UPB_ALIGN) static unsigned char memory[UPB_MODEL_BYTES_MAX];
    unsigned columns = 0;
    upb_stream_config config = upb_stream_config_default();
    config.sink = on_column;
    config.user = &columns;
    upb_model *model = nullptr;
    upb_error error;
    CHECK_EQUAL(upb_model_load(memory, sizeof memory, "UPBX", 4, &model, &error), UPB_E_MAGIC);
    CHECK(model == nullptr && error.status == UPB_E_MAGIC);
    upb_stream *stream = nullptr;
    CHECK_EQUAL(upb_stream_init(memory, sizeof memory, model, &config, &stream, &error), UPB_E_ARGUMENT);
    CHECK(stream == nullptr && strcmp(error.what, "model") == 0);
    upb_histogram histogram;
    upb_histogram_reset(&histogram);
    upb_histogram_add(&histogram, 17);
    CHECK_EQUAL(upb_histogram_quantile(&histogram, 500000), 17);
    return check_report("header (C++)");
}
