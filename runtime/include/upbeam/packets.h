/*
 * upbeam packets: UDP payloads of Velodyne sensors to firings and back.
 *
 * No heap, no threads, no I/O, no globals; needs libc and libm only. The caller gives all memory: the structs here are
 * plain and may lie anywhere. Every byte that comes in is taken for hostile: reads are bounded, every loop is.
 *
 * Usage:
 *     upb_packet_decoder decoder;
 *     upb_packet_decoder_config config = upb_packet_decoder_config_default();
 *     upb_firing firings[UPB_PACKET_FIRINGS];
 *     uint32_t count;
 *     if (upb_packet_decoder_init(&decoder, &config) != UPB_PACKET_OK) ...
 *     for (;;) {
 *         upb_packet_status status = upb_packet_decode(&decoder, payload, bytes, firings, &count, NULL);
 *         if (status != UPB_PACKET_OK) printf("%s\n", upb_packet_status_text(status));   // counted in decoder.stats
 *         for (uint32_t k = 0; k < count; k++) ...
 *     }
 *
 * Units: distance is the sensor's own count (upb_sensor_info.distance_unit_um each; 0 is "no return"), intensity
 * 0..255, angles are thousandths of a degree (mdeg), azimuth clockwise seen from above, 0..359999; times are
 * nanoseconds. Beam 0 is the top one. A firing is one shot of all lasers: one azimuth, one column.
 */
#ifndef UPBEAM_PACKETS_H
#define UPBEAM_PACKETS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define UPB_PACKET_BYTES 1206u         /* a data packet's UDP payload */
#define UPB_POSITION_PACKET_BYTES 512u /* a position packet's */
#define UPB_PACKET_FIRINGS 24u         /* firings of one packet, at most: a VLP-16's */
#define UPB_PACKET_BEAMS 64u           /* beams of a firing, at most */
#define UPB_PACKET_BLOCKS 12u
#define UPB_FULL_TURN_MDEG 360000u
#define UPB_HOUR_NS UINT64_C(3600000000000)

/* ------------------------------------------------------------------------------------------------------ outcomes */

/* Why a packet, a calibration or a call was refused. Values are stable: they are counted, logged and sent on buses. */
typedef enum upb_packet_status {
    UPB_PACKET_OK = 0,
    UPB_PACKET_E_ARGUMENT = 1,     /* a null pointer, or a configuration value outside its range */
    UPB_PACKET_E_SIZE = 2,         /* neither 1206 nor 512 bytes */
    UPB_PACKET_E_FLAG = 3,         /* a block does not begin with its bank's flag (an empty packet: block 0) */
    UPB_PACKET_E_AZIMUTH = 4,      /* a block's azimuth is 360 degrees or more */
    UPB_PACKET_E_TIME = 5,         /* the time is an hour or more */
    UPB_PACKET_E_RETURN_MODE = 6,  /* the return mode byte is none of strongest, last, dual */
    UPB_PACKET_E_MODEL = 7,        /* the model byte is no sensor known */
    UPB_PACKET_E_SENSOR = 8,       /* of another sensor than the decoder's */
    UPB_PACKET_E_POSITION = 9,     /* a position packet's PPS state is none known, or its NMEA sentence is not text */
    UPB_PACKET_E_CALIBRATION = 10, /* a calibration that cannot be: laser_id not unique, elevation rising, ... */
    UPB_PACKET_E_RETURN_PAIR = 11, /* blocks of one firing do not share their azimuth */
    /* Known and refused, by name. */
    UPB_PACKET_E_VLS_128 = 12,
    UPB_PACKET_E_VLP_32AB = 13,
    UPB_PACKET_E_PUCK_HIRES = 14,
    UPB_PACKET_E_VELARRAY = 15,
    UPB_PACKET_E_OUSTER = 16
} upb_packet_status;

#define UPB_PACKET_STATUSES 17u

/* One lower-case English sentence without full stop, static, never null. */
const char *upb_packet_status_text(upb_packet_status status);

/* ------------------------------------------------------------------------------------------------------- sensors */

typedef enum upb_sensor {
    UPB_SENSOR_AUTO = 0, /* found by the first good data packet, then kept */
    UPB_SENSOR_HDL_32E = 1,
    UPB_SENSOR_VLP_32C = 2,
    UPB_SENSOR_VLP_16 = 3,
    UPB_SENSOR_HDL_64E_S2 = 4,
    UPB_SENSOR_HDL_64E_S3 = 5, /* a single packet of an HDL-64E does not tell its series: S3 until its record does */
    /* Recognised, never decoded. */
    UPB_SENSOR_VLS_128 = 6,
    UPB_SENSOR_VLP_32AB = 7,
    UPB_SENSOR_PUCK_HIRES = 8,
    UPB_SENSOR_VELARRAY = 9,
    UPB_SENSOR_OUSTER = 10
} upb_sensor;

#define UPB_SENSORS 11u

typedef enum upb_return_mode {
    UPB_RETURN_STRONGEST = 0x37,
    UPB_RETURN_LAST = 0x38,
    UPB_RETURN_DUAL = 0x39
} upb_return_mode;

typedef struct upb_sensor_info {
    const char *name;          /* "hdl-32e": the name of its beam table */
    uint32_t beams;            /* of a firing; 0: the sensor is not decoded */
    uint32_t distance_unit_um; /* size of a distance count, micrometres */
    uint32_t firing_cycle_ns;  /* from firing to firing */
    uint32_t packet_firings;   /* firings of a single-return packet */
    uint8_t model;             /* last byte of its packets; 0: an HDL-64E has none */
    uint8_t blocks_per_firing; /* 2: an HDL-64E's upper and lower bank; else 1 */
    uint8_t firings_per_block; /* 2: a VLP-16's; else 1 */
} upb_sensor_info;

/* Static; null for a value that is no upb_sensor. */
const upb_sensor_info *upb_sensor_info_get(upb_sensor sensor);
/* By name, any case; UPB_SENSOR_AUTO for an unknown one. */
upb_sensor upb_sensor_by_name(const char *name);

/* --------------------------------------------------------------------------------------------------- calibration */

/* Where a laser points, and what its raw values need. Sizes in micrometres, as per-unit tables give them. */
typedef struct upb_laser {
    int32_t elevation_mdeg;         /* above the horizon */
    int32_t azimuth_offset_mdeg;    /* clockwise, from the firing's azimuth to the laser's */
    uint32_t fire_time_ns;          /* after the firing's begin */
    int32_t distance_correction_um; /* added to a distance (at 25 m, on an HDL-64E) */
    int32_t distance_x_um;          /* the same at 2.4 m (HDL-64E); 0: distance_correction_um at all distances */
    int32_t distance_y_um;          /* the same at 1.93 m */
    int32_t vertical_offset_um;     /* height of the laser's origin over the sensor's */
    int32_t horizontal_offset_um;   /* sideways shift of its origin, to the left of its direction (as tables give it) */
    int32_t focal_distance_um;      /* intensity correction; 0: none */
    int32_t focal_slope_e4;         /* focal slope, ten-thousandths */
    uint8_t min_intensity;
    uint8_t max_intensity;
    uint8_t laser_id; /* the maker's number: its place in a block; 32 and more: the lower bank's */
    uint8_t reserved;
} upb_laser;

typedef struct upb_packet_calibration {
    upb_sensor sensor;
    uint32_t beams;                    /* = upb_sensor_info.beams */
    uint32_t two_point;                /* 1: distance_x_um and distance_y_um count below 25 m (HDL-64E) */
    upb_laser laser[UPB_PACKET_BEAMS]; /* top beam first */
} upb_packet_calibration;

/* The nominal table of a sensor (model/beam_tables). E_ARGUMENT for a sensor that is not decoded. */
upb_packet_status upb_packet_calibration_default(upb_sensor sensor, upb_packet_calibration *calibration);
/* Laser numbers unique and of the sensor, elevations never rising, within +-90 degrees, offsets within +-90, times in
 * the cycle, intensities in order. E_CALIBRATION, and *beam is the first bad one (may be null). */
upb_packet_status upb_packet_calibration_check(const upb_packet_calibration *calibration, uint32_t *beam);
/* Sorts the lasers top beam first. */
void upb_packet_calibration_sort(upb_packet_calibration *calibration);
/*
 * The table of an HDL-64E S3 that a 64-row column is written as: row 2k (measured) is laser k in the upper bank,
 * 0xEEFF; row 2k+1 (generated) laser 32+k in the lower, 0xDDFF. All corrections are 0 but azimuth_offset_mdeg, which
 * takes back the turn that drivers add for each laser's firing time. They reckon it from the azimuths in the packets
 * and an S3's own cycle, so it depends on the azimuth from column to column: on turn_columns, the columns of a full
 * turn at nominal speed (4..65535). All rows of a column are then decoded at its azimuth; at another speed they spread
 * (docs/packets.md). Elevations fall strictly and differ after rounding to 0.01 degrees, or E_CALIBRATION.
 */
upb_packet_status upb_packet_calibration_rows(const int32_t row_elevation_mdeg[UPB_PACKET_BEAMS], uint32_t turn_columns,
                                              upb_packet_calibration *calibration);

/* ------------------------------------------------------------------------------------------------------- identify */

typedef enum upb_packet_kind {
    UPB_PACKET_KIND_UNKNOWN = 0,
    UPB_PACKET_KIND_DATA = 1,
    UPB_PACKET_KIND_POSITION = 2
} upb_packet_kind;

/* What one packet tells about itself. */
typedef struct upb_packet_info {
    upb_packet_kind kind;
    upb_sensor sensor;           /* AUTO: unknown. HDL_64E_S3 stands for both series */
    upb_return_mode return_mode; /* an HDL-64E's is in its record: STRONGEST here, DUAL where blocks come in pairs */
    uint32_t block;              /* of an error: the block it was found in */
    uint32_t got;                /* of an error: the value found */
    uint32_t azimuth_mdeg;       /* of block 0 */
    uint32_t time_us;            /* after the hour */
    uint8_t status_type;         /* last two bytes: HDL-64E's status, else return mode and model */
    uint8_t status_value;
} upb_packet_info;

/*
 * What a payload is. Checks all of it but the returns: a data packet that is OK here decodes. Sensors that are known
 * and not decoded are named by the status and by info->sensor.
 */
upb_packet_status upb_packet_identify(const uint8_t *bytes, size_t n, upb_packet_info *info);

/* --------------------------------------------------------------------------------------------------------- firing */

#define UPB_FIRING_SECOND 1u       /* the other return of a dual pair: follows its primary, same azimuth and time */
#define UPB_FIRING_INTERPOLATED 2u /* its azimuth stands in no block: the second firing of a VLP-16's block */
/* Within its packet, the azimuth jumped just before it: a sensor told to send a part of the turn leaves out the rest.
 * Its time, and of those behind it, is then reckoned from the azimuth: packets tell it of their first firing only. */
#define UPB_FIRING_JUMP 4u
#define UPB_FIRING_EMPTY 8u /* no beam has a return */
#define UPB_FIRING_DUAL 16u /* of a dual-return packet, primary or second */

typedef struct upb_firing {
    uint64_t time_ns;      /* begin of the firing by the sensor's clock. Goes on past the hour: time_ns % UPB_HOUR_NS is
                              the sensor's; counted from the hour before the decoder's first packet */
    uint32_t azimuth_mdeg; /* at the begin of the firing, 0..359999 */
    uint32_t rate_mdeg_s;  /* rotation by this packet's blocks, mdeg per second; 0: unknown */
    uint16_t flags;        /* UPB_FIRING_* */
    uint8_t beams;         /* used of distance and intensity; the rest is 0 */
    uint8_t return_kind;   /* UPB_RETURN_STRONGEST or UPB_RETURN_LAST: what the sensor says of this block */
    uint16_t distance[UPB_PACKET_BEAMS];
    uint8_t intensity[UPB_PACKET_BEAMS];
} upb_firing;

/* A measured point: x forward at azimuth 0, y left, z up (azimuth is clockwise: y = -r sin). */
typedef struct upb_point {
    float x_m, y_m, z_m;
    uint8_t intensity;
    uint8_t beam;
    uint16_t reserved;
    uint32_t azimuth_mdeg; /* of the laser: offset and turn during the firing included */
    uint32_t distance_um;  /* corrected */
} upb_point;

/* Points of a firing's returns, top beam first; returns how many (at most firing->beams, 0 for a calibration that
 * cannot be). A return that the distance correction takes to 0 or below is no point. Intensity is not corrected. */
uint32_t upb_firing_points(const upb_packet_calibration *calibration, const upb_firing *firing,
                           upb_point points[UPB_PACKET_BEAMS]);

/* ---------------------------------------------------------------------------------------------- HDL-64E's record */

#define UPB_RECORD_BYTES 1820u
#define UPB_RECORD_PACKETS 4160u /* packets until a stream has told its record: 16 each for 7 bytes of it */

/* Warning bits, of status type 'W'. */
#define UPB_WARNING_LENS 1u /* lens contaminated */
#define UPB_WARNING_HOT 2u  /* too hot inside */
#define UPB_WARNING_COLD 4u /* too cold inside */
#define UPB_WARNING_VOLTAGE_LOW 8u
#define UPB_WARNING_VOLTAGE_HIGH 16u
#define UPB_WARNING_PPS 32u /* not a warning: PPS signal present */
#define UPB_WARNING_GPS 64u /* not a warning: GPS time present */

/* What an HDL-64E tells of itself in the last two bytes of its packets. */
typedef struct upb_hdl64e_status {
    uint8_t hour, minute, second, day, month, year; /* UTC; year after 2000 */
    uint8_t gps;                                    /* 'A' valid, 'V' not, 0 none */
    uint8_t temperature_c;
    uint8_t firmware;
    uint8_t warnings; /* UPB_WARNING_* */
    uint8_t upper_threshold, lower_threshold;
    uint8_t calibrated[6]; /* year after 2000, month, day, hour, minute, second; 255: unknown */
    uint8_t humidity;      /* percent */
    uint8_t returns;       /* 0 strongest, 1 last, 2 both */
    uint8_t power_level;
    uint8_t reserved;
    uint16_t rpm;
    uint16_t fov_min_cdeg, fov_max_cdeg;
    uint16_t life_hours;
    uint8_t ip_source[4], ip_destination[4];
} upb_hdl64e_status;

/* Writes the 1820 bytes: angles rounded to 0.01 degrees, lengths to 1 mm (E_CALIBRATION where they do not fit 16 bits).
 * The checksum is an S3's CRC-16 or the length, an S2's, by calibration->sensor. */
upb_packet_status upb_record_write(const upb_packet_calibration *calibration, const upb_hdl64e_status *status,
                                   uint8_t record[UPB_RECORD_BYTES]);
/* Reads them: calibration sorted, top beam first. E_CALIBRATION: checksum, or impossible values. */
upb_packet_status upb_record_read(const uint8_t record[UPB_RECORD_BYTES], upb_packet_calibration *calibration,
                                  upb_hdl64e_status *status);

/* -------------------------------------------------------------------------------------------------------- decoder */

/* Of a dual return's two firings, the primary: the one for the network. */
typedef enum upb_pick {
    UPB_PICK_STRONGEST = 0, /* beam by beam the brighter return, the other one in the second firing: where the last
                               return is the strongest, sensors send the second strongest in the strongest's place */
    UPB_PICK_LAST = 1       /* the block of last returns, whole; the second firing is the other block, whole */
} upb_pick;

typedef struct upb_packet_decoder_config {
    upb_sensor sensor; /* AUTO, or one that is decoded: packets of others are E_SENSOR */
    upb_pick pick;
    const upb_packet_calibration *calibration; /* copied; null: the sensor's nominal one. Not with AUTO */
    uint32_t keep_calibration;                 /* 1: an HDL-64E's own record does not replace it */
    uint32_t reserved[4];                      /* 0 */
} upb_packet_decoder_config;

upb_packet_decoder_config upb_packet_decoder_config_default(void);

typedef struct upb_packet_stats {
    uint64_t packets[UPB_PACKET_STATUSES]; /* by outcome; [UPB_PACKET_OK] data and position packets */
    uint64_t positions;                    /* of these, position packets: no firings */
    uint64_t firings;                      /* handed out, second returns included */
    uint64_t jumps;                        /* UPB_FIRING_JUMP */
    uint64_t hours;                        /* the sensor's clock passed the hour */
    uint64_t records;                      /* HDL-64E records read */
    uint64_t records_bad;                  /* complete, and damaged: packets were lost on the way */
} upb_packet_stats;

/* Read `calibration`, `status` and `stats` freely; leave the rest to the functions. */
typedef struct upb_packet_decoder {
    upb_packet_decoder_config config;
    upb_sensor sensor;                  /* AUTO until the first good data packet */
    upb_packet_calibration calibration; /* in use: the HDL-64E's own once its record was read */
    upb_hdl64e_status status;           /* HDL-64E only */
    upb_packet_stats stats;
    uint64_t hour_ns; /* private from here on */
    uint32_t last_time_us;
    uint32_t last_rate_mdeg_s;
    uint32_t record_bytes;
    uint8_t slot_beam[UPB_PACKET_BEAMS];
    uint8_t record[UPB_RECORD_BYTES];
} upb_packet_decoder;

upb_packet_status upb_packet_decoder_init(upb_packet_decoder *decoder, const upb_packet_decoder_config *config);

/*
 * One payload to firings, in time order (dual: each primary, then its second). *count is 0 unless OK, and for a
 * position packet. A packet is decoded whole or refused whole. `info` may be null.
 */
upb_packet_status upb_packet_decode(upb_packet_decoder *decoder, const uint8_t *bytes, size_t n,
                                    upb_firing firings[UPB_PACKET_FIRINGS], uint32_t *count, upb_packet_info *info);

/* -------------------------------------------------------------------------------------------------------- encoder */

typedef struct upb_packet_encoder_config {
    upb_sensor sensor; /* one that is decoded */
    upb_return_mode return_mode;
    const upb_packet_calibration *calibration; /* copied; null: nominal. Tells each beam's place in the blocks, and an
                                                  HDL-64E's record */
    uint32_t distance_unit_um;                 /* of the firings' counts; 0: the sensor's. A whole multiple of it
                                                  (4 mm counts in an HDL-64E's packets: doubled) */
    upb_hdl64e_status status;                  /* HDL-64E only: the first state */
    uint32_t reserved[4];                      /* 0 */
} upb_packet_encoder_config;

upb_packet_encoder_config upb_packet_encoder_config_default(upb_sensor sensor);

typedef struct upb_packet_encoder_stats {
    uint64_t packets;
    uint64_t firings;
    uint64_t too_far; /* returns beyond 65535 counts of the sensor (131 m at 2 mm): written as no return */
} upb_packet_encoder_stats;

/* `status` may be changed between packets: its clock, temperature, warnings go out with the next ones; the rest, which
 * is in the record, with upb_packet_encoder_set_record. */
typedef struct upb_packet_encoder {
    upb_packet_encoder_config config;
    upb_hdl64e_status status;
    upb_packet_encoder_stats stats;
    uint32_t scale;  /* private from here on */
    uint32_t placed; /* firings in the packet under construction */
    uint32_t cycle;  /* next status byte: 0..15 in the cycle */
    uint32_t record_at;
    uint8_t place_beam[UPB_PACKET_BEAMS];
    uint8_t packet[UPB_PACKET_BYTES];
    uint8_t record[UPB_RECORD_BYTES];
} upb_packet_encoder;

upb_packet_status upb_packet_encoder_init(upb_packet_encoder *encoder, const upb_packet_encoder_config *config);

/*
 * Adds a firing; *ready is 1 when this completed a packet, which was copied to `packet`. A packet holds
 * upb_sensor_info.packet_firings of them, half as many pairs in dual return: push the strongest with flags 0, then the
 * last with UPB_FIRING_SECOND (written first, as sensors do). The packet's time is its first firing's. A VLP-16's
 * second firing of a block has no azimuth of its own on the wire. E_ARGUMENT: too few beams, an azimuth out of range, a
 * second return that was not expected or is missing; nothing is taken then.
 */
upb_packet_status upb_packet_encode(upb_packet_encoder *encoder, const upb_firing *firing,
                                    uint8_t packet[UPB_PACKET_BYTES], uint32_t *ready);
/* Firings that wait for a packet to fill. */
uint32_t upb_packet_encoder_pending(const upb_packet_encoder *encoder);
/* Drops them, e.g. after a gap: packets hold no time step. Returns how many. */
uint32_t upb_packet_encoder_drop(upb_packet_encoder *encoder);
/* HDL-64E: a new table, e.g. for another speed; begins the record anew. */
upb_packet_status upb_packet_encoder_set_record(upb_packet_encoder *encoder, const upb_packet_calibration *calibration);

/* ----------------------------------------------------------------------------------------------- position packets */

typedef enum upb_pps { UPB_PPS_ABSENT = 0, UPB_PPS_SYNCING = 1, UPB_PPS_LOCKED = 2, UPB_PPS_ERROR = 3 } upb_pps;

#define UPB_NMEA_BYTES 128u

/* Temperatures are degrees Celsius, of firmware since 2018; 0 before. */
typedef struct upb_position {
    uint32_t time_us; /* after the hour */
    upb_pps pps;
    uint8_t thermal_shutdown; /* 1: the sensor has stopped its lasers */
    uint8_t temperature_top, temperature_bottom;
    uint8_t temperature_at_shutdown, temperature_at_power_up;
    uint8_t adc_temperature; /* at the last ADC calibration */
    int16_t adc_temperature_change;
    uint32_t adc_seconds;          /* since the last ADC calibration */
    uint8_t adc_reason;            /* 0 none, 1 power-on, 2 manual, 3 temperature, 4 periodic */
    uint8_t adc_flags;             /* 1 in progress, 2 temperature limit, 4 period elapsed */
    uint8_t nmea_valid;            /* 1: a sentence with a right checksum */
    char nmea[UPB_NMEA_BYTES + 1]; /* zero terminated, "$GPRMC,..." without line end; empty: none */
} upb_position;

/* E_SIZE, E_TIME, E_POSITION. */
upb_packet_status upb_position_decode(const uint8_t *bytes, size_t n, upb_position *position);
/* E_ARGUMENT where a value is out of range. The NMEA sentence is written with a line end. */
upb_packet_status upb_position_encode(const upb_position *position, uint8_t bytes[UPB_POSITION_PACKET_BYTES]);

/* ------------------------------------------------------------------------------------------------ azimuth tracking */

#define UPB_STEP_FIRST 1u /* the first firing */
#define UPB_STEP_FRAME 2u /* crossed the cut: first firing of its frame */
#define UPB_STEP_LATE 4u  /* behind the last one: reordered or a duplicate; the tracker stays where it was */
#define UPB_STEP_STUCK 8u /* time went on, the azimuth did not */
#define UPB_STEP_TIME_JUMP                                                                                             \
    16u /* the sensor's clock and its azimuth tell different stories: the azimuth is believed                          \
         */
#define UPB_STEP_RESTART                                                                                               \
    32u /* more than UPB_TRACKER_LOST_NS without a firing, or the clock went back: nothing is known                    \
           of what lies between; `missing` is 0 */

#define UPB_TRACKER_LOST_NS UINT64_C(1000000000)

typedef struct upb_step {
    uint32_t flags;   /* UPB_STEP_* */
    uint32_t missing; /* firings estimated lost before this one */
    int64_t firing;   /* running number, lost ones included: 0 is the first. Late: that of its place, may be negative */
    int64_t angle_mdeg; /* since the cut before the first firing; a turn adds 360000 */
    uint64_t frame;     /* turns begun since the first firing, by the cut */
    uint32_t rpm_milli; /* thousandths of a turn per minute, smoothed over some 32 firings; 0: unknown */
} upb_step;

typedef struct upb_azimuth_tracker {
    uint32_t cut_mdeg;
    uint32_t cycle_ns; /* private from here on */
    uint32_t started;
    uint32_t azimuth_mdeg;
    uint64_t time_ns;
    int64_t firing;
    int64_t angle_mdeg;
    uint64_t frame;
    uint64_t rate_mdeg_s_q8;
} upb_azimuth_tracker;

/* cut_mdeg 0..359999; cycle_ns: upb_sensor_info.firing_cycle_ns. */
upb_packet_status upb_azimuth_tracker_init(upb_azimuth_tracker *tracker, uint32_t cut_mdeg, uint32_t cycle_ns);
/* The place of a primary firing (not UPB_FIRING_SECOND) in the turn, and what is missing before it. */
upb_step upb_azimuth_track(upb_azimuth_tracker *tracker, const upb_firing *firing);
/* Firings in a full turn at the tracked speed, rounded; 0: unknown. */
uint32_t upb_azimuth_turn_firings(const upb_azimuth_tracker *tracker);

#ifdef __cplusplus
}
#endif

#endif
