/*
 * AES-128 (FIPS 197) encryption and CMAC (RFC 4493, NIST SP 800-38B). The S-box is computed, not looked up: no branch
 * and no address depends on key or data, on any compiler that keeps masks as masks.
 */
#include <string.h>

#include "upb_bytes.h"
#include "upbeam/command.h"

enum { BLOCK = 16, ROUNDS = 10 };

typedef struct aes_key {
    uint8_t round[ROUNDS + 1][BLOCK];
} aes_key;

/* Eight field elements, one in each byte of a word: the arithmetic works on all of them at once. */
typedef uint64_t lanes;

#define EACH(byte) (UINT64_C(0x0101010101010101) * (byte))

/* 0xff in each byte whose lowest bit is set in `bits`, 0 elsewhere. */
static lanes mask_of(lanes bits) {
    bits &= EACH(1);
    return (bits << 8) - bits;
}

/* x times the polynomial `x`, modulo x^8 + x^4 + x^3 + x + 1. */
static lanes times_two(lanes x) { return (x << 1 & EACH(0xfe)) ^ (mask_of(x >> 7) & EACH(0x1b)); }

static lanes multiply(lanes a, lanes b) {
    lanes product = 0;
    for (int bit = 0; bit < 8; bit++) {
        product ^= a & mask_of(b >> bit);
        a = times_two(a);
    }
    return product;
}

/* x^254: the inverse, and 0 for 0. 254 = 2 * (120 + 7), by way of 3, 7, 15. */
static lanes inverse(lanes x) {
    const lanes x2 = multiply(x, x), x3 = multiply(x2, x);
    const lanes x6 = multiply(x3, x3), x7 = multiply(x6, x);
    const lanes x14 = multiply(x7, x7), x15 = multiply(x14, x);
    const lanes x30 = multiply(x15, x15), x60 = multiply(x30, x30);
    const lanes x120 = multiply(x60, x60), x127 = multiply(x120, x7);
    return multiply(x127, x127);
}

static lanes rotated(lanes x, int by) {
    const lanes low = EACH((1u << by) - 1u);
    return (x << by & ~low) | (x >> (8 - by) & low);
}

static lanes substitute(lanes x) {
    const lanes y = inverse(x);
    return y ^ rotated(y, 1) ^ rotated(y, 2) ^ rotated(y, 3) ^ rotated(y, 4) ^ EACH(0x63);
}

static void expand_key(const uint8_t key[BLOCK], aes_key *expanded) {
    uint8_t constant = 1;
    memcpy(expanded->round[0], key, BLOCK);
    for (int r = 1; r <= ROUNDS; r++) {
        const uint8_t *before = expanded->round[r - 1];
        uint8_t *now = expanded->round[r];
        const lanes last = substitute(upb_get_le(before + 12, 4));
        for (int i = 0; i < 4; i++)
            now[i] = (uint8_t)(before[i] ^ (last >> 8 * ((i + 1) % 4)));
        now[0] ^= constant;
        constant = (uint8_t)times_two(constant);
        for (int i = 4; i < BLOCK; i++)
            now[i] = before[i] ^ now[i - 4];
    }
}

/* SubBytes and ShiftRows: row r of the column-wise state turns left by r. */
static void substitute_and_shift(uint8_t state[BLOCK]) {
    uint8_t all[BLOCK];
    upb_put_le(all, substitute(upb_get_le(state, 8)), 8);
    upb_put_le(all + 8, substitute(upb_get_le(state + 8, 8)), 8);
    for (int column = 0; column < 4; column++)
        for (int row = 0; row < 4; row++)
            state[4 * column + row] = all[4 * ((column + row) % 4) + row];
}

/* MixColumns, two columns in a word: 2 s[r] + 3 s[r+1] + s[r+2] + s[r+3] in each row. */
static lanes mixed(lanes s) {
    const lanes three = UINT64_C(0x00ffffff00ffffff), two = UINT64_C(0x0000ffff0000ffff);
    const lanes next = (s >> 8 & three) | (s << 24 & ~three);                         /* s[r+1] */
    const lanes pair = s ^ next, far_pair = (pair >> 16 & two) | (pair << 16 & ~two); /* s[r+2] + s[r+3] */
    return times_two(pair) ^ next ^ far_pair;
}

static void mix_columns(uint8_t state[BLOCK]) {
    upb_put_le(state, mixed(upb_get_le(state, 8)), 8);
    upb_put_le(state + 8, mixed(upb_get_le(state + 8, 8)), 8);
}

static void add(uint8_t state[BLOCK], const uint8_t *other) {
    for (int i = 0; i < BLOCK; i++)
        state[i] ^= other[i];
}

static void encrypt(const aes_key *key, uint8_t state[BLOCK]) {
    add(state, key->round[0]);
    for (int r = 1; r <= ROUNDS; r++) {
        substitute_and_shift(state);
        if (r < ROUNDS)
            mix_columns(state);
        add(state, key->round[r]);
    }
}

/* Times x in the field of 128 bits (RFC 4493, 2.3): the subkeys. */
static void double_block(uint8_t block[BLOCK]) {
    const uint8_t carry = (uint8_t)(0x87 & -(block[0] >> 7));
    for (int i = 0; i < BLOCK - 1; i++)
        block[i] = (uint8_t)(block[i] << 1 | block[i + 1] >> 7);
    block[BLOCK - 1] = (uint8_t)(block[BLOCK - 1] << 1 ^ carry);
}

/* A wipe the compiler may not leave out. */
static void wipe(void *memory, size_t count) {
    volatile uint8_t *p = memory;
    while (count--)
        *p++ = 0;
}

void upb_cmac(const uint8_t key[UPB_KEY_BYTES], const uint8_t *bytes, size_t count, uint8_t mac[16]) {
    aes_key expanded;
    uint8_t state[BLOCK] = {0}, last[BLOCK] = {0}, subkey[BLOCK] = {0};
    expand_key(key, &expanded);
    encrypt(&expanded, subkey);
    double_block(subkey);
    for (; count > BLOCK; count -= BLOCK, bytes += BLOCK) {
        add(state, bytes);
        encrypt(&expanded, state);
    }
    if (count)
        memcpy(last, bytes, count);
    if (count < BLOCK) {
        last[count] = 0x80;
        double_block(subkey);
    }
    add(last, subkey);
    add(state, last);
    encrypt(&expanded, state);
    memcpy(mac, state, BLOCK);
    wipe(&expanded, sizeof expanded);
    wipe(subkey, sizeof subkey);
}
