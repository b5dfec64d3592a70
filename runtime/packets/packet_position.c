/* Position packets: the sensor's clock, its pulse per second, the GPS sentence, its temperatures. */
#include <string.h>

#include "packet_wire.h"

#define TEMPERATURES_AT 187u /* top board, bottom board, at the last ADC calibration */
#define ADC_CHANGE_AT 190u
#define ADC_SECONDS_AT 192u
#define ADC_REASON_AT 196u
#define ADC_FLAGS_AT 197u
#define PPS_AT 202u
#define THERMAL_AT 203u /* shutdown, temperature then, temperature at power-up */
#define NMEA_AT 206u
#define NMEA_LINE_END 2u
#define ADC_REASONS 5u
#define ADC_FLAGS 7u

static int is_text(char c) { return c >= 0x20 && c < 0x7F; }

static int hex_digit(char c) {
    if (c >= '0' && c <= '9')
        return c - '0';
    if (c >= 'A' && c <= 'F')
        return c - 'A' + 10;
    return c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

/* "$...*hh": hh is the exclusive or of what stands between. */
static uint8_t checksum_holds(const char *nmea, uint32_t n) {
    if (n < 4 || nmea[0] != '$' || nmea[n - 3] != '*')
        return 0;
    int sum = 0;
    for (uint32_t k = 1; k < n - 3; k++)
        sum ^= nmea[k];
    return sum == 16 * hex_digit(nmea[n - 2]) + hex_digit(nmea[n - 1]);
}

static upb_packet_status read_nmea(const uint8_t *at, upb_position *position) {
    uint32_t n = 0;
    while (n < UPB_NMEA_BYTES && at[n] && at[n] != '\r' && at[n] != '\n') {
        position->nmea[n] = (char)at[n];
        if (!is_text(position->nmea[n]))
            return UPB_PACKET_E_POSITION;
        n++;
    }
    position->nmea[n] = 0;
    position->nmea_valid = checksum_holds(position->nmea, n);
    return UPB_PACKET_OK;
}

upb_packet_status upb_position_decode(const uint8_t *bytes, size_t n, upb_position *position) {
    if (!bytes || !position)
        return UPB_PACKET_E_ARGUMENT;
    memset(position, 0, sizeof *position);
    if (n != UPB_POSITION_PACKET_BYTES)
        return UPB_PACKET_E_SIZE;
    position->time_us = wire_get32(bytes + WIRE_POSITION_TIME_AT);
    if (position->time_us >= WIRE_HOUR_US)
        return UPB_PACKET_E_TIME;
    if (bytes[PPS_AT] > UPB_PPS_ERROR)
        return UPB_PACKET_E_POSITION;
    position->pps = (upb_pps)bytes[PPS_AT];
    position->temperature_top = bytes[TEMPERATURES_AT];
    position->temperature_bottom = bytes[TEMPERATURES_AT + 1];
    position->adc_temperature = bytes[TEMPERATURES_AT + 2];
    const int32_t change = (int32_t)wire_get16(bytes + ADC_CHANGE_AT);
    position->adc_temperature_change = (int16_t)(change < 0x8000 ? change : change - 0x10000);
    position->adc_seconds = wire_get32(bytes + ADC_SECONDS_AT);
    position->adc_reason = bytes[ADC_REASON_AT];
    position->adc_flags = bytes[ADC_FLAGS_AT];
    position->thermal_shutdown = bytes[THERMAL_AT] == 1;
    position->temperature_at_shutdown = bytes[THERMAL_AT + 1];
    position->temperature_at_power_up = bytes[THERMAL_AT + 2];
    return read_nmea(bytes + NMEA_AT, position);
}

static int position_can_be(const upb_position *position, uint32_t *nmea_bytes) {
    uint32_t n = 0;
    while (n < UPB_NMEA_BYTES && position->nmea[n]) {
        if (!is_text(position->nmea[n]))
            return 0;
        n++;
    }
    *nmea_bytes = n;
    return n + NMEA_LINE_END <= UPB_NMEA_BYTES && position->time_us < WIRE_HOUR_US &&
           (uint32_t)position->pps <= UPB_PPS_ERROR && position->thermal_shutdown <= 1 &&
           position->adc_reason < ADC_REASONS && position->adc_flags <= ADC_FLAGS;
}

upb_packet_status upb_position_encode(const upb_position *position, uint8_t bytes[UPB_POSITION_PACKET_BYTES]) {
    uint32_t n = 0;
    if (!position || !bytes || !position_can_be(position, &n))
        return UPB_PACKET_E_ARGUMENT;
    memset(bytes, 0, UPB_POSITION_PACKET_BYTES);
    bytes[TEMPERATURES_AT] = position->temperature_top;
    bytes[TEMPERATURES_AT + 1] = position->temperature_bottom;
    bytes[TEMPERATURES_AT + 2] = position->adc_temperature;
    wire_put16(bytes + ADC_CHANGE_AT, (uint32_t)position->adc_temperature_change & 0xFFFFu);
    wire_put32(bytes + ADC_SECONDS_AT, position->adc_seconds);
    bytes[ADC_REASON_AT] = position->adc_reason;
    bytes[ADC_FLAGS_AT] = position->adc_flags;
    wire_put32(bytes + WIRE_POSITION_TIME_AT, position->time_us);
    bytes[PPS_AT] = (uint8_t)position->pps;
    bytes[THERMAL_AT] = position->thermal_shutdown;
    bytes[THERMAL_AT + 1] = position->temperature_at_shutdown;
    bytes[THERMAL_AT + 2] = position->temperature_at_power_up;
    if (n) {
        memcpy(bytes + NMEA_AT, position->nmea, n);
        memcpy(bytes + NMEA_AT + n, "\r\n", NMEA_LINE_END);
    }
    return UPB_PACKET_OK;
}
