#include "upb_column_wire.h"

#include <string.h>

static const uint8_t magic[4] = {'U', 'P', 'C', 'S'};

static void put_u16(uint8_t *at, uint32_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

static void put_u32(uint8_t *at, uint32_t value) {
    put_u16(at, value);
    put_u16(at + 2, value >> 16);
}

static void put_u64(uint8_t *at, uint64_t value) {
    put_u32(at, (uint32_t)value);
    put_u32(at + 4, (uint32_t)(value >> 32));
}

static uint32_t get_u16(const uint8_t *at) { return (uint32_t)at[0] | (uint32_t)at[1] << 8; }
static uint32_t get_u32(const uint8_t *at) { return get_u16(at) | get_u16(at + 2) << 16; }
static uint64_t get_u64(const uint8_t *at) { return get_u32(at) | (uint64_t)get_u32(at + 4) << 32; }

size_t upb_wire_bytes(uint32_t columns) { return UPB_WIRE_HEADER_BYTES + (size_t)columns * UPB_WIRE_COLUMN_BYTES; }

void upb_wire_write_header(const upb_wire_header *header, uint8_t *datagram) {
    memcpy(datagram, magic, sizeof magic);
    datagram[4] = UPB_WIRE_VERSION;
    datagram[5] = UPB_WIRE_HEADER_BYTES;
    datagram[6] = (uint8_t)header->columns;
    datagram[7] = UPB_ROWS;
    put_u32(datagram + 8, header->sequence);
    put_u32(datagram + 12, header->model_crc32);
    put_u64(datagram + 16, header->frame);
    put_u32(datagram + 24, header->distance_unit_um);
    put_u32(datagram + 28, header->turn_columns);
}

void upb_wire_write_column(const upb_wire_column *column, uint32_t index, uint8_t *datagram) {
    uint8_t *at = datagram + upb_wire_bytes(index);
    put_u32(at, column->column);
    put_u32(at + 4, column->azimuth_mdeg);
    put_u64(at + 8, column->time_ns);
    put_u32(at + 16, column->flags);
    at += 20;
    for (unsigned row = 0; row < UPB_ROWS; row++)
        put_u16(at + 2 * row, column->distance[row]);
    memcpy(at + 2 * UPB_ROWS, column->intensity, UPB_ROWS);
}

upb_status upb_wire_read_header(const uint8_t *datagram, size_t bytes, upb_wire_header *header) {
    if (bytes < UPB_WIRE_HEADER_BYTES)
        return UPB_E_TRUNCATED;
    if (memcmp(datagram, magic, sizeof magic) != 0)
        return UPB_E_MAGIC;
    if (datagram[4] != UPB_WIRE_VERSION)
        return UPB_E_VERSION;
    if (datagram[5] != UPB_WIRE_HEADER_BYTES || datagram[6] == 0 || datagram[6] > UPB_WIRE_COLUMNS ||
        datagram[7] != UPB_ROWS)
        return UPB_E_VALUE;
    if (bytes != upb_wire_bytes(datagram[6]))
        return UPB_E_TRUNCATED;
    header->columns = datagram[6];
    header->sequence = get_u32(datagram + 8);
    header->model_crc32 = get_u32(datagram + 12);
    header->frame = get_u64(datagram + 16);
    header->distance_unit_um = get_u32(datagram + 24);
    header->turn_columns = get_u32(datagram + 28);
    return UPB_OK;
}

void upb_wire_read_column(const uint8_t *datagram, uint32_t index, upb_wire_column *column) {
    const uint8_t *at = datagram + upb_wire_bytes(index);
    column->column = get_u32(at);
    column->azimuth_mdeg = get_u32(at + 4);
    column->time_ns = get_u64(at + 8);
    column->flags = get_u32(at + 16);
    at += 20;
    for (unsigned row = 0; row < UPB_ROWS; row++)
        column->distance[row] = (uint16_t)get_u16(at + 2 * row);
    memcpy(column->intensity, at + 2 * UPB_ROWS, UPB_ROWS);
}
