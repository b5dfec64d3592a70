/* Reports of what is wrong in a model file. */
#include "upb_reader.h"

upb_status upb_bad_value(const upb_reader *r, const char *what, size_t at, uint64_t got, uint64_t expected) {
    return upb_fail(r->error, UPB_E_VALUE, what, at, got, expected);
}

upb_status upb_ranged(const upb_reader *r, const char *what, size_t at, uint32_t low, uint32_t high, uint32_t *value) {
    *value = upb_u32_at(r, at);
    if (*value < low || *value > high)
        return upb_bad_value(r, what, at, *value, *value < low ? low : high);
    return UPB_OK;
}

void upb_append_index(char *text, unsigned index) {
    char digits[3];
    unsigned n = 0;
    do {
        digits[n++] = (char)('0' + index % 10);
        index /= 10;
    } while (index);
    text += strlen(text);
    *text++ = '[';
    while (n)
        *text++ = digits[--n];
    *text++ = ']';
    *text = 0;
}

upb_status upb_bad_element(const upb_reader *r, const char *what, unsigned index, size_t at, uint64_t got,
                           uint64_t expected) {
    char text[32] = "";
    strncat(text, what, 26);
    upb_append_index(text, index);
    return upb_bad_value(r, text, at, got, expected);
}
