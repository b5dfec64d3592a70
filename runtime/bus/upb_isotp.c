/* ISO-TP (ISO 15765-2): normal addressing, classic 8-byte frames, one message each way at a time. */
#include <string.h>

#include "upbeam/uds.h"

enum { FRAME = UPB_CAN_CLASSIC_BYTES, SINGLE_MAX = 7, FIRST_DATA = 6, SEND_MAX = 16 };
enum { PCI_SINGLE = 0, PCI_FIRST = 1, PCI_CONSECUTIVE = 2, PCI_FLOW = 3 };
enum { RX_IDLE = 0, RX_BUSY = 1, RX_COMPLETE = 2 };
enum { TX_IDLE = 0, TX_BEGIN = 1, TX_WAIT_FLOW = 2, TX_CONSECUTIVE = 3 };
enum { FLOW_CONTINUE = 0, FLOW_WAIT = 1, FLOW_OVERFLOW = 2 };

upb_isotp_config upb_isotp_config_default(void) {
    upb_isotp_config config;
    memset(&config, 0, sizeof config);
    config.n_bs_ns = config.n_cr_ns = 1000000000u;
    config.wait_max = 8;
    config.padding = 0xcc;
    return config;
}

upb_status upb_isotp_init(upb_isotp *link, const upb_isotp_config *config, const upb_can_transport *transport) {
    if (!link || !config || !transport || config->tx_id > 0x7ff || config->rx_id > 0x7ff || config->rx_id_all > 0x7ff ||
        config->st_min > 127 || !config->n_bs_ns || !config->n_cr_ns)
        return UPB_E_ARGUMENT;
    memset(link, 0, sizeof *link);
    link->config = *config;
    link->transport = *transport;
    return UPB_OK;
}

static void end_receive(upb_isotp *link, upb_isotp_error cause) {
    link->errors[cause]++;
    link->rx_state = RX_IDLE;
    link->flow_pending = 0;
}

static void end_send(upb_isotp *link, upb_isotp_error cause) {
    link->errors[cause]++;
    link->tx_state = TX_IDLE;
}

/* ------------------------------------------------------------------------------------------------ receive */

/* Makes way for a new message; false if the last one still waits to be taken. */
static int begin_receive(upb_isotp *link) {
    if (link->rx_state == RX_COMPLETE) {
        link->errors[UPB_ISOTP_UNEXPECTED]++;
        return 0;
    }
    if (link->rx_state == RX_BUSY)
        end_receive(link, UPB_ISOTP_UNEXPECTED);
    return 1;
}

static void receive_single(upb_isotp *link, const upb_can_frame *frame, int functional) {
    const uint8_t count = frame->data[0] & 15u;
    if (count == 0 || count > SINGLE_MAX || count > frame->length - 1) {
        link->errors[UPB_ISOTP_MALFORMED]++;
        return;
    }
    if (!begin_receive(link))
        return;
    memcpy(link->rx, frame->data + 1, count);
    link->rx_length = link->rx_have = count;
    link->rx_functional = (uint8_t)functional;
    link->rx_state = RX_COMPLETE;
}

static void receive_first(upb_isotp *link, const upb_can_frame *frame, int functional, uint64_t now_ns) {
    const uint16_t count = (uint16_t)((frame->data[0] & 15u) << 8 | frame->data[1]);
    /* A length of 0 announces the 32-bit form, for messages above 4095 bytes. */
    if (functional || frame->length != FRAME || (count && count <= SINGLE_MAX)) {
        link->errors[UPB_ISOTP_MALFORMED]++;
        return;
    }
    if (!begin_receive(link))
        return;
    if (count == 0 || count > UPB_ISOTP_BYTES) {
        link->errors[UPB_ISOTP_OVERFLOW]++;
        link->flow_pending = FLOW_OVERFLOW + 1;
        return;
    }
    memcpy(link->rx, frame->data + 2, FIRST_DATA);
    link->rx_length = count;
    link->rx_have = FIRST_DATA;
    link->rx_functional = 0;
    link->rx_sequence = 1;
    link->rx_block = link->config.block_size;
    link->rx_state = RX_BUSY;
    link->rx_deadline_ns = now_ns + link->config.n_cr_ns;
    link->flow_pending = FLOW_CONTINUE + 1;
}

static void receive_consecutive(upb_isotp *link, const upb_can_frame *frame, uint64_t now_ns) {
    if (link->rx_state != RX_BUSY) {
        link->errors[UPB_ISOTP_UNEXPECTED]++;
        return;
    }
    const uint32_t left = (uint32_t)link->rx_length - link->rx_have;
    const uint32_t count = left < SINGLE_MAX ? left : SINGLE_MAX;
    if ((frame->data[0] & 15u) != link->rx_sequence) {
        end_receive(link, UPB_ISOTP_WRONG_SEQUENCE);
        return;
    }
    if (frame->length - 1u < count) {
        end_receive(link, UPB_ISOTP_MALFORMED);
        return;
    }
    memcpy(link->rx + link->rx_have, frame->data + 1, count);
    link->rx_have = (uint16_t)(link->rx_have + count);
    link->rx_sequence = (link->rx_sequence + 1u) & 15u;
    link->rx_deadline_ns = now_ns + link->config.n_cr_ns;
    if (link->rx_have == link->rx_length)
        link->rx_state = RX_COMPLETE;
    else if (link->config.block_size && --link->rx_block == 0) {
        link->rx_block = link->config.block_size;
        link->flow_pending = FLOW_CONTINUE + 1;
    }
}

/* Milliseconds, or 100 to 900 microseconds; reserved values are the longest (ISO 15765-2). */
static uint64_t gap_ns(uint8_t st_min) {
    if (st_min <= 127)
        return st_min * (uint64_t)1000000;
    return st_min >= 0xf1 && st_min <= 0xf9 ? (st_min - 0xf0u) * (uint64_t)100000 : (uint64_t)127000000;
}

static void receive_flow(upb_isotp *link, const upb_can_frame *frame, uint64_t now_ns) {
    if (link->tx_state != TX_WAIT_FLOW) {
        link->errors[UPB_ISOTP_UNEXPECTED]++;
        return;
    }
    if (frame->length < 3) {
        link->errors[UPB_ISOTP_MALFORMED]++;
        return;
    }
    switch (frame->data[0] & 15u) {
    case FLOW_CONTINUE:
        link->tx_block = frame->data[1];
        link->tx_gap_ns = gap_ns(frame->data[2]);
        link->tx_waits = 0;
        link->tx_state = TX_CONSECUTIVE;
        link->tx_deadline_ns = now_ns;
        break;
    case FLOW_WAIT:
        link->tx_deadline_ns = now_ns + link->config.n_bs_ns;
        if (link->tx_waits++ == link->config.wait_max)
            end_send(link, UPB_ISOTP_WAIT_EXCEEDED);
        break;
    case FLOW_OVERFLOW:
        end_send(link, UPB_ISOTP_OVERFLOW);
        break;
    default:
        end_send(link, UPB_ISOTP_MALFORMED);
    }
}

/* A late frame is too late, however seldom upb_isotp_step is called. */
static void end_late(upb_isotp *link, uint64_t now_ns) {
    if (link->rx_state == RX_BUSY && now_ns >= link->rx_deadline_ns)
        end_receive(link, UPB_ISOTP_TIMEOUT_CR);
    if (link->tx_state == TX_WAIT_FLOW && now_ns >= link->tx_deadline_ns)
        end_send(link, UPB_ISOTP_TIMEOUT_BS);
}

int upb_isotp_receive(upb_isotp *link, const upb_can_frame *frame, uint64_t now_ns) {
    if (!upb_can_frame_is_valid(frame) || frame->flags)
        return 0;
    const int functional = link->config.rx_id_all && frame->id == link->config.rx_id_all;
    if (!functional && frame->id != link->config.rx_id)
        return 0;
    end_late(link, now_ns);
    const uint32_t pci = frame->length ? frame->data[0] >> 4 : 15u;
    if (pci == PCI_SINGLE)
        receive_single(link, frame, functional);
    else if (pci == PCI_FIRST && frame->length >= 2)
        receive_first(link, frame, functional, now_ns);
    else if (pci == PCI_CONSECUTIVE && !functional)
        receive_consecutive(link, frame, now_ns);
    else if (pci == PCI_FLOW && !functional)
        receive_flow(link, frame, now_ns);
    else
        link->errors[UPB_ISOTP_MALFORMED]++;
    return 1;
}

const uint8_t *upb_isotp_message(const upb_isotp *link, size_t *count, int *functional) {
    if (link->rx_state != RX_COMPLETE)
        return NULL;
    *count = link->rx_length;
    *functional = link->rx_functional;
    return link->rx;
}

void upb_isotp_take(upb_isotp *link) {
    if (link->rx_state == RX_COMPLETE)
        link->rx_state = RX_IDLE;
}

/* --------------------------------------------------------------------------------------------------- send */

static upb_send emit(upb_isotp *link, const uint8_t *head, size_t head_bytes, const uint8_t *body, size_t body_bytes) {
    upb_can_frame frame = {.id = link->config.tx_id, .length = FRAME};
    if (!link->transport.send)
        return UPB_SEND_FAILED;
    memset(frame.data, link->config.padding, FRAME);
    memcpy(frame.data, head, head_bytes);
    if (body_bytes)
        memcpy(frame.data + head_bytes, body, body_bytes);
    return link->transport.send(link->transport.user, &frame);
}

upb_status upb_isotp_send(upb_isotp *link, const uint8_t *bytes, size_t count, uint64_t now_ns) {
    if (!link || !bytes || count == 0 || count > UPB_ISOTP_BYTES)
        return UPB_E_ARGUMENT;
    if (link->tx_state != TX_IDLE)
        return UPB_E_ORDER;
    memcpy(link->tx, bytes, count);
    link->tx_length = (uint16_t)count;
    link->tx_sent = 0;
    link->tx_sequence = 1;
    link->tx_waits = 0;
    link->tx_state = TX_BEGIN;
    upb_isotp_step(link, now_ns);
    return UPB_OK;
}

int upb_isotp_is_sending(const upb_isotp *link) { return link->tx_state != TX_IDLE; }

static upb_send send_begin(upb_isotp *link, uint64_t now_ns) {
    const int single = link->tx_length <= SINGLE_MAX;
    const uint8_t head[2] = {(uint8_t)(single ? link->tx_length : PCI_FIRST << 4 | link->tx_length >> 8),
                             (uint8_t)link->tx_length};
    const uint16_t count = single ? link->tx_length : FIRST_DATA;
    const upb_send sent = emit(link, head, single ? 1 : 2, link->tx, count);
    if (sent == UPB_SEND_DONE) {
        link->tx_sent = count;
        link->tx_state = single ? TX_IDLE : TX_WAIT_FLOW;
        link->tx_deadline_ns = now_ns + link->config.n_bs_ns;
    }
    return sent;
}

static upb_send send_consecutive(upb_isotp *link, uint64_t now_ns) {
    const uint32_t left = (uint32_t)link->tx_length - link->tx_sent;
    const uint32_t count = left < SINGLE_MAX ? left : SINGLE_MAX;
    const uint8_t head = (uint8_t)(PCI_CONSECUTIVE << 4 | link->tx_sequence);
    const upb_send sent = emit(link, &head, 1, link->tx + link->tx_sent, count);
    if (sent != UPB_SEND_DONE)
        return sent;
    link->tx_sent = (uint16_t)(link->tx_sent + count);
    link->tx_sequence = (link->tx_sequence + 1u) & 15u;
    link->tx_deadline_ns = now_ns + link->tx_gap_ns;
    if (link->tx_sent == link->tx_length)
        link->tx_state = TX_IDLE;
    else if (link->tx_block && --link->tx_block == 0) {
        link->tx_state = TX_WAIT_FLOW;
        link->tx_deadline_ns = now_ns + link->config.n_bs_ns;
    }
    return sent;
}

static void send_flow(upb_isotp *link) {
    const uint8_t head[3] = {(uint8_t)(PCI_FLOW << 4 | (link->flow_pending - 1)), link->config.block_size,
                             link->config.st_min};
    const upb_send sent = emit(link, head, sizeof head, NULL, 0);
    if (sent == UPB_SEND_BUSY)
        return;
    link->flow_pending = 0;
    if (sent == UPB_SEND_FAILED)
        end_receive(link, UPB_ISOTP_SEND_FAILED);
}

void upb_isotp_step(upb_isotp *link, uint64_t now_ns) {
    end_late(link, now_ns);
    if (link->flow_pending)
        send_flow(link);
    for (int i = 0; i < SEND_MAX; i++) {
        upb_send sent = UPB_SEND_BUSY;
        if (link->tx_state == TX_BEGIN)
            sent = send_begin(link, now_ns);
        else if (link->tx_state == TX_CONSECUTIVE && now_ns >= link->tx_deadline_ns)
            sent = send_consecutive(link, now_ns);
        if (sent == UPB_SEND_FAILED)
            end_send(link, UPB_ISOTP_SEND_FAILED);
        if (sent != UPB_SEND_DONE)
            return;
    }
}
