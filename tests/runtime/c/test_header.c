/* The public header compiles alone, first and twice, and every call links from the shared library. */
#include "upbeam/upbeam.h"

#include "check.h"

_Static_assert(sizeof(upb_stream_config) == 6 * 4 + 10 * 4 + 2 * sizeof(void *), "no padding in the configuration");
_Static_assert(sizeof(upb_ledger_record) == 5 * 8 + 4 * 4, "no padding in a record: it leaves the process");

int main(void) {
    const upb_stream_config config = upb_stream_config_default();
    CHECK_EQUAL(upb_api_version(), UPB_API_VERSION);
    CHECK(strchr(upb_version(), '.') != NULL);
    CHECK_EQUAL(config.struct_bytes, sizeof config);
    CHECK(upb_model_bytes() <= UPB_MODEL_BYTES_MAX);
    CHECK(!upb_row_is_generated(0) && upb_row_is_generated(63));
    for (int status = UPB_OK; status <= UPB_E_SIGNATURE; status++)
        CHECK(strlen(upb_status_text((upb_status)status)) > 5 &&
              strcmp(upb_status_text((upb_status)status), "unknown status"));
    CHECK(strcmp(upb_status_text((upb_status)(UPB_E_SIGNATURE + 1)), "unknown status") == 0);
    CHECK(strcmp(upb_status_text((upb_status)-1), "unknown status") == 0);
    return check_report("header (C)");
}
