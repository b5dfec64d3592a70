/*
 * The column stream: finished columns in UDP datagrams, lossless. docs/column-stream.md has the format to the byte;
 * column_stream.py reads it. All numbers are little-endian.
 */
#ifndef UPB_COLUMN_WIRE_H
#define UPB_COLUMN_WIRE_H

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UPB_WIRE_VERSION 1u
#define UPB_WIRE_HEADER_BYTES 32u
#define UPB_WIRE_COLUMN_BYTES (20u + 3u * UPB_ROWS)
#define UPB_WIRE_COLUMNS 6u /* of a datagram, at most */
#define UPB_WIRE_BYTES_MAX (UPB_WIRE_HEADER_BYTES + UPB_WIRE_COLUMNS * UPB_WIRE_COLUMN_BYTES)

/* Flags of a column; the first two are UPB_COLUMN_INCOMPLETE and UPB_COLUMN_LAST, the mode stands where those have it.
 */
#define UPB_WIRE_SECOND 4u   /* the other return of the column before: even rows only, no return in generated rows */
#define UPB_WIRE_INSERTED 8u /* the firing never arrived: its azimuth and time are estimated */

/* All columns of a datagram are of one frame. */
typedef struct upb_wire_header {
    uint32_t columns;     /* in the datagram, 1..UPB_WIRE_COLUMNS */
    uint32_t sequence;    /* of the datagram, from 0 */
    uint32_t model_crc32; /* of the model file that made the generated rows */
    uint32_t distance_unit_um;
    uint32_t turn_columns; /* per turn, nominal */
    uint64_t frame;
} upb_wire_header;

typedef struct upb_wire_column {
    uint32_t column;       /* in its frame, from 0; a second return has its column's */
    uint32_t azimuth_mdeg; /* 0..359999 */
    uint64_t time_ns;      /* the sensor's clock, hours counted on */
    uint32_t flags;
    uint16_t distance[UPB_ROWS];
    uint8_t intensity[UPB_ROWS];
} upb_wire_column;

/* Bytes of a datagram with so many columns. */
size_t upb_wire_bytes(uint32_t columns);
void upb_wire_write_header(const upb_wire_header *header, uint8_t *datagram);
/* Column `index` of the datagram. */
void upb_wire_write_column(const upb_wire_column *column, uint32_t index, uint8_t *datagram);
/* Errors: TRUNCATED, MAGIC, VERSION, VALUE (a number outside its range). */
upb_status upb_wire_read_header(const uint8_t *datagram, size_t bytes, upb_wire_header *header);
/* Of a datagram whose header was read; `index` < header.columns. */
void upb_wire_read_column(const uint8_t *datagram, uint32_t index, upb_wire_column *column);

#ifdef __cplusplus
}
#endif

#endif /* UPB_COLUMN_WIRE_H */
