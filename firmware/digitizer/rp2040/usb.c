// SPDX-License-Identifier: Apache-2.0

/* A USB CDC ACM device: bytes both ways in bulk packets. Line coding is accepted and ignored, but for 1200
 * baud, by which a host asks for the boot ROM's USB drive, as it does with many boards. DTR tells whether a
 * program has opened the port; one that does not raise it has opened it once it sends something.
 */
#include "byte_ring.h"
#include "nodes.h"
#include "registers.h"
#include "rp2040.h"
#include "usb_descriptors.h"

enum direction { DIR_IN, DIR_OUT };
enum { GET_STATUS = 0, CLEAR_FEATURE = 1, SET_ADDRESS = 5, GET_DESCRIPTOR = 6,
       GET_CONFIGURATION = 8, SET_CONFIGURATION = 9,
       SET_LINE_CODING = 0x20, GET_LINE_CODING = 0x21, SET_CONTROL_LINE_STATE = 0x22 };
enum { TO_DEVICE = 0x00, TO_INTERFACE = 0x01, TO_ENDPOINT = 0x02, CLASS = 0x20, FROM_DEVICE = 0x80 };

#define IN_BUFFERS 2u
#define BAUD_OF_BOOTSEL 1200u
#define DTR 1u /* of the control lines */

struct setup_packet {
    uint8_t request_type, request;
    uint16_t value, index, length;
};

/* Buffers in the controller's memory, as offsets from its start. */
#define EP0_BUFFER 0x100u
#define NOTIFY_BUFFER 0x180u
#define IN_BUFFER 0x1c0u /* two of them */
#define OUT_BUFFER 0x240u

static struct byte_ring received;
static uint8_t serial[8];
static uint32_t next_data1[3][2]; /* data toggle of each endpoint's next packet */
static volatile bool configured, opened, suspended, receiving, sending;
/* Bulk packets that wait for the host to take them; while it takes one, the next is there already. */
static struct { uint32_t count, oldest; bool first; } offered;
static const uint8_t *to_send;
static size_t to_send_left;
static bool sent_full; /* whether the last packet was full */
static uint32_t frame_us; /* when the bus's present frame of 1 ms began */
static bool held_back;    /* a bulk packet waits for the next frame */

/* The control transfer in progress. */
static const uint8_t *reply;
static size_t reply_left;
static bool reply_zero; /* it ends with an empty packet */
static uint8_t new_address;

static volatile uint32_t *memory(uint32_t offset)
{
    return (volatile uint32_t *)((uintptr_t)USB_DPRAM + offset);
}

static void copy_in(uint32_t offset, const uint8_t *bytes, size_t size)
{
    volatile uint32_t *to = memory(offset);
    const uint8_t *end = bytes + size;

    for (; end - bytes >= 4; bytes += 4)
        *to++ = bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 |
                (uint32_t)bytes[3] << 24;
    if (bytes == end)
        return;
    uint32_t rest = 0;
    while (end > bytes)
        rest = rest << 8 | *--end;
    *to = rest;
}

static void copy_out(uint8_t *bytes, uint32_t offset, size_t size)
{
    for (size_t i = 0; i < size; i++)
        bytes[i] = (uint8_t)(*memory(offset + (i & ~3u)) >> 8 * (i & 3u));
}

/* The control of a buffer: 0, or of the bulk endpoint's two for IN also 1. */
static volatile uint16_t *control_of(uint32_t endpoint, enum direction direction, uint32_t buffer)
{
    return (volatile uint16_t *)&USB_DPRAM->ep_buf_ctrl[endpoint][direction] + buffer;
}

/* Gives the controller a buffer: a full one for IN, an empty one for OUT. */
static void hand_over_buffer(uint32_t endpoint, enum direction direction, uint32_t buffer,
                             uint32_t bits)
{
    volatile uint16_t *control = control_of(endpoint, direction, buffer);
    uint32_t *data1 = &next_data1[endpoint][direction];

    bits |= *data1;
    *data1 ^= USB_BUF_CTRL_DATA1_PID;
    *control = (uint16_t)bits;
    /* AVAILABLE must reach clk_usb after the other bits: wait 5 of its cycles, 10 of clk_sys */
    __asm__ volatile("nop\n nop\n nop\n nop\n nop\n nop\n nop\n nop\n nop\n nop" ::: "memory");
    *control = (uint16_t)(bits | USB_BUF_CTRL_AVAIL);
}

static void hand_over(uint32_t endpoint, enum direction direction, uint32_t bits)
{
    hand_over_buffer(endpoint, direction, 0, bits);
}

static void control_send(const uint8_t *bytes, size_t size)
{
    copy_in(EP0_BUFFER, bytes, size);
    hand_over(EP_CONTROL, DIR_IN, USB_BUF_CTRL_FULL | size);
}

static void control_receive(void)
{
    hand_over(EP_CONTROL, DIR_OUT, USB_PACKET);
}

static void control_stall(void)
{
    USB->ep_stall_arm = 3; /* endpoint 0, both directions */
    USB_DPRAM->ep_buf_ctrl[EP_CONTROL][DIR_IN] = USB_BUF_CTRL_STALL;
    USB_DPRAM->ep_buf_ctrl[EP_CONTROL][DIR_OUT] = USB_BUF_CTRL_STALL;
}

/* Sends the next packet of a reply; after the last one, waits for the host's empty packet. */
static void reply_next(void)
{
    if (!reply_left && !reply_zero) {
        next_data1[EP_CONTROL][DIR_OUT] = USB_BUF_CTRL_DATA1_PID;
        control_receive();
        return;
    }
    size_t size = reply_left < USB_PACKET ? reply_left : USB_PACKET;
    reply_zero &= reply_left != 0;
    control_send(reply, size);
    reply += size;
    reply_left -= size;
}

static void reply_with(const struct setup_packet *setup, const uint8_t *bytes, size_t size)
{
    reply = bytes;
    reply_left = size < setup->length ? size : setup->length;
    reply_zero = size < setup->length && size % USB_PACKET == 0;
    reply_next();
}

static void reply_string(const struct setup_packet *setup)
{
    static const char *const texts[] = {
        [USB_MANUFACTURER] = "tactile_cdma",
        [USB_PRODUCT] = nodes_product,
    };
    static const char digits[] = "0123456789ABCDEF";
    static uint8_t string[USB_PACKET];
    uint8_t index = (uint8_t)setup->value;
    size_t size = 2;

    if (index == USB_LANGUAGES) {
        string[size++] = 0x09; /* English (US) */
        string[size++] = 0x04;
    } else if (index == USB_SERIAL) {
        for (size_t i = 0; i < 2 * sizeof serial; i++, size += 2)
            string[size] = (uint8_t)digits[serial[i / 2] >> (i % 2 ? 0 : 4) & 15];
    } else if (index <= USB_PRODUCT) {
        for (const char *text = texts[index]; *text; text++, size += 2)
            string[size] = (uint8_t)*text;
    } else {
        control_stall();
        return;
    }
    for (size_t i = 3; index != USB_LANGUAGES && i < size; i += 2)
        string[i] = 0; /* UTF-16 */
    string[0] = (uint8_t)size;
    string[1] = USB_STRING;
    reply_with(setup, string, size);
}

static void reply_descriptor(const struct setup_packet *setup)
{
    switch (setup->value >> 8) {
    case USB_DEVICE:
        reply_with(setup, device_descriptor, sizeof device_descriptor);
        break;
    case USB_CONFIGURATION:
        reply_with(setup, configuration_descriptor, sizeof configuration_descriptor);
        break;
    case USB_STRING:
        reply_string(setup);
        break;
    default: /* among them the device qualifier: there is no high speed */
        control_stall();
    }
}

/* RP2040-E15: a bus error during an IN transaction can stop the controller until it is unplugged. Hubs of
 * USB 2 make one where a packet meets a frame's end; so none is offered in its last fifth. pico-sdk's
 * TinyUSB does the same (PICO_RP2040_USB_DEVICE_UFRAME_FIX), with the same times. */
static bool late_in_frame(void)
{
    uint32_t since = TIMER->timerawl - frame_us;

    return since >= 800 && since <= 998; /* later: the host sends no frames */
}

static void send_packet(void)
{
    size_t size = to_send_left < USB_PACKET ? to_send_left : USB_PACKET;

    held_back = late_in_frame();
    if (held_back)
        return;
    uint32_t buffer = (offered.oldest + offered.count) % IN_BUFFERS;
    copy_in(IN_BUFFER + buffer * USB_PACKET, to_send, size);
    hand_over_buffer(EP_DATA, DIR_IN, buffer,
                     USB_BUF_CTRL_FULL | (offered.first ? USB_BUF_CTRL_SEL : 0) | size);
    offered.count++;
    offered.first = false;
    to_send += size;
    to_send_left -= size;
    sent_full = size == USB_PACKET;
}

static void send_packets(void)
{
    do
        send_packet();
    while (to_send_left && offered.count < IN_BUFFERS && !held_back);
    sending = to_send_left || held_back;
}

/* The host has taken bulk packets. */
static void packets_taken(void)
{
    while (offered.count &&
           !(*control_of(EP_DATA, DIR_IN, offered.oldest) & USB_BUF_CTRL_AVAIL)) {
        offered.oldest = (offered.oldest + 1) % IN_BUFFERS;
        offered.count--;
    }
    if (to_send_left && offered.count < IN_BUFFERS)
        send_packets();
}

/* Accepts a bulk packet from the host if there is room for it; otherwise the host has to wait. */
static void receive_next(void)
{
    receiving = byte_ring_room(&received) >= USB_PACKET;
    if (receiving)
        hand_over(EP_DATA, DIR_OUT, USB_PACKET);
}

/* Nobody reads any more: discards what was left to send. The packets that the controller has stay there,
 * because the host may be about to take one, but of zeros: the next program gets delimiters, nothing stale. */
static void let_go(void)
{
    to_send_left = 0;
    sending = held_back = false;
    for (uint32_t i = 0; i < offered.count; i++)
        for (uint32_t place = 0; place < USB_PACKET; place += 4)
            *memory(IN_BUFFER + (offered.oldest + i) % IN_BUFFERS * USB_PACKET + place) = 0;
}

static void open(bool by_host)
{
    if (!by_host)
        let_go();
    opened = by_host;
}

/* Discards what was left to send, including the packet in the controller: it was for another host. */
static void set_configuration(uint8_t configuration)
{
    for (uint32_t endpoint = EP_NOTIFY; endpoint <= EP_DATA; endpoint++) {
        for (uint32_t direction = DIR_IN; direction <= DIR_OUT; direction++) {
            USB_DPRAM->ep_buf_ctrl[endpoint][direction] = 0;
            next_data1[endpoint][direction] = 0;
        }
    }
    sending = sent_full = held_back = false;
    offered.count = offered.oldest = 0;
    offered.first = true;
    to_send_left = 0;
    opened = suspended = false;
    configured = configuration != 0;
    if (configured)
        receive_next();
}

/* Resets a halted endpoint's data toggle; keeps its packets, which the host has not taken. Some hosts do
 * this whenever a program opens the port. */
static void clear_halt(const struct setup_packet *setup)
{
    uint32_t endpoint = setup->index & 15u;
    enum direction direction = setup->index & 0x80 ? DIR_IN : DIR_OUT;

    if (endpoint != EP_DATA)
        return;
    next_data1[endpoint][direction] = 0;
    if (direction == DIR_OUT)
        receive_next();
    else
        for (uint32_t i = 0; i < offered.count; i++) {
            uint32_t buffer = (offered.oldest + i) % IN_BUFFERS;
            uint32_t size = *control_of(EP_DATA, DIR_IN, buffer) & USB_BUF_CTRL_LEN_MASK;
            hand_over_buffer(EP_DATA, DIR_IN, buffer, USB_BUF_CTRL_FULL | size);
        }
}

/* Handles requests without data; false if the request is unknown. */
static bool obey(const struct setup_packet *setup)
{
    switch (setup->request_type << 8 | setup->request) {
    case TO_DEVICE << 8 | SET_ADDRESS:
        new_address = (uint8_t)setup->value; /* takes effect once this request is acknowledged */
        break;
    case TO_DEVICE << 8 | SET_CONFIGURATION:
        set_configuration((uint8_t)setup->value);
        break;
    case TO_ENDPOINT << 8 | CLEAR_FEATURE:
        clear_halt(setup);
        break;
    case (CLASS | TO_INTERFACE) << 8 | SET_CONTROL_LINE_STATE:
        open(setup->value & DTR);
        break;
    default:
        return false;
    }
    control_send(NULL, 0);
    return true;
}

static void control_request(void)
{
    static const uint8_t zeros[2];
    static const uint8_t line_coding[7] = {LE16(0xc200), LE16(1), 0, 0, 8}; /* 115200 8N1 */
    static uint8_t configuration;
    uint32_t low = USB_DPRAM->setup_packet[0], high = USB_DPRAM->setup_packet[1];
    struct setup_packet setup = {
        .request_type = (uint8_t)low,
        .request = (uint8_t)(low >> 8),
        .value = (uint16_t)(low >> 16),
        .index = (uint16_t)high,
        .length = (uint16_t)(high >> 16),
    };

    next_data1[EP_CONTROL][DIR_IN] = next_data1[EP_CONTROL][DIR_OUT] = USB_BUF_CTRL_DATA1_PID;
    new_address = 0;
    switch (setup.request_type << 8 | setup.request) {
    case (FROM_DEVICE | TO_DEVICE) << 8 | GET_DESCRIPTOR:
        reply_descriptor(&setup);
        break;
    case (FROM_DEVICE | TO_DEVICE) << 8 | GET_CONFIGURATION:
        configuration = configured;
        reply_with(&setup, &configuration, 1);
        break;
    case (FROM_DEVICE | TO_DEVICE) << 8 | GET_STATUS:
    case (FROM_DEVICE | TO_INTERFACE) << 8 | GET_STATUS:
    case (FROM_DEVICE | TO_ENDPOINT) << 8 | GET_STATUS:
        reply_with(&setup, zeros, sizeof zeros);
        break;
    case (FROM_DEVICE | CLASS | TO_INTERFACE) << 8 | GET_LINE_CODING:
        reply_with(&setup, line_coding, sizeof line_coding);
        break;
    case (CLASS | TO_INTERFACE) << 8 | SET_LINE_CODING:
        control_receive();
        break;
    default:
        if (!obey(&setup))
            control_stall();
    }
}

/* The host has read or filled a buffer. */
static void buffer_done(uint32_t endpoint, enum direction direction)
{
    uint32_t size = USB_DPRAM->ep_buf_ctrl[endpoint][direction] & USB_BUF_CTRL_LEN_MASK;
    uint8_t bytes[USB_PACKET];

    if (endpoint == EP_CONTROL && direction == DIR_IN) {
        if (new_address) {
            USB->dev_addr_ctrl = new_address;
            new_address = 0;
        } else if (reply) {
            reply_next();
        }
    } else if (endpoint == EP_CONTROL) {
        if (reply) {
            reply = NULL; /* the end of a reply */
        } else { /* a line coding: nothing else comes with data */
            if (size >= 4 && *memory(EP0_BUFFER) == BAUD_OF_BOOTSEL)
                bootsel_ask();
            control_send(NULL, 0);
        }
    } else if (direction == DIR_IN) {
        packets_taken();
    } else {
        copy_out(bytes, OUT_BUFFER, size);
        byte_ring_put(&received, bytes, size);
        opened = true;
        receive_next();
    }
}

static void buffers_done(void)
{
    uint32_t done = USB->buf_status;

    for (uint32_t i = 0; i < 2 * (EP_DATA + 1); i++) {
        if (done & 1u << i) {
            USB->buf_status = 1u << i;
            buffer_done(i / 2, i % 2 ? DIR_OUT : DIR_IN);
        }
    }
}

void usb_interrupt(void)
{
    uint32_t status = USB->ints;

    if (status & USB_INTS_DEV_SUSPEND_BITS) { /* no frame for 3 ms: it sleeps or is gone, or else is back */
        USB->sie_status = USB_SIE_STATUS_SUSPENDED_BITS;
        suspended = true;
        let_go();
    }
    if (status & USB_INTS_DEV_SOF_BITS) {
        frame_us = TIMER->timerawl;
        (void)USB->sof_rd;
        suspended = false;
        if (held_back)
            send_packets();
    }
    if (status & USB_INTS_BUS_RESET_BITS) {
        USB->sie_status = USB_SIE_STATUS_BUS_RESET_BITS;
        USB->dev_addr_ctrl = 0;
        USB->buf_status = ~0u; /* of transfers before the reset */
        set_configuration(0);
    }
    if (status & USB_INTS_BUFF_STATUS_BITS) /* before a new request, because it completes the previous one */
        buffers_done();
    if (status & USB_INTS_SETUP_REQ_BITS) {
        USB->sie_status = USB_SIE_STATUS_SETUP_REC_BITS;
        for (uint32_t direction = DIR_IN; direction <= DIR_OUT; direction++)
            USB_DPRAM->ep_buf_ctrl[EP_CONTROL][direction] = 0; /* of an abandoned request */
        reply = NULL;
        control_request();
    }
    if (status & ~USB_INTS_DEV_SOF_BITS)
        wake();
}

void usb_init(const uint8_t id[8], uint32_t current_ma)
{
    configuration_descriptor[CONFIGURATION_MAX_POWER] = (uint8_t)(current_ma / 2);
    for (size_t i = 0; i < sizeof serial; i++)
        serial[i] = id[i];
    reset_blocks(RESETS_RESET_USBCTRL_BITS);
    for (uint32_t offset = 0; offset < EP0_BUFFER; offset += 4)
        *memory(offset) = 0;
    const uint32_t on = EP_CTRL_ENABLE_BITS | EP_CTRL_INTERRUPT_PER_BUFFER;
    USB_DPRAM->ep_ctrl[EP_NOTIFY - 1][DIR_IN] = on | USB_EP_TYPE(USB_INTERRUPT) | NOTIFY_BUFFER;
    USB_DPRAM->ep_ctrl[EP_DATA - 1][DIR_IN] = on | EP_CTRL_DOUBLE_BUFFERED_BITS | USB_EP_TYPE(USB_BULK) |
                                              IN_BUFFER;
    USB_DPRAM->ep_ctrl[EP_DATA - 1][DIR_OUT] = on | USB_EP_TYPE(USB_BULK) | OUT_BUFFER;

    USB->muxing = USB_USB_MUXING_TO_PHY_BITS | USB_USB_MUXING_SOFTCON_BITS;
    USB->pwr = USB_USB_PWR_VBUS_DETECT_BITS | USB_USB_PWR_VBUS_DETECT_OVERRIDE_EN_BITS;
    USB->main_ctrl = USB_MAIN_CTRL_CONTROLLER_EN_BITS;
    USB->inte = USB_INTS_BUFF_STATUS_BITS | USB_INTS_BUS_RESET_BITS | USB_INTS_SETUP_REQ_BITS |
                USB_INTS_DEV_SOF_BITS | USB_INTS_DEV_SUSPEND_BITS;
    NVIC_ISER = 1u << USBCTRL_IRQ;
    USB->sie_ctrl = USB_SIE_CTRL_EP0_INT_1BUF_BITS | USB_SIE_CTRL_PULLUP_EN_BITS;
}

bool usb_ready(void)
{
    return configured && opened && !suspended;
}

size_t usb_read(uint8_t *bytes, size_t size)
{
    size_t count = byte_ring_get(&received, bytes, size);

    interrupts_off();
    if (configured && !receiving)
        receive_next();
    interrupts_on();
    return count;
}

void usb_send(const uint8_t *bytes, size_t size)
{
    interrupts_off(); /* a bus reset or a closed port would end all sending */
    if (usb_ready() && (size || (sent_full && !offered.count))) {
        to_send = bytes;
        to_send_left = size;
        sending = true;
        if (offered.count < IN_BUFFERS) /* else it follows those packets */
            send_packets();
    }
    interrupts_on();
}

size_t usb_cancel(void)
{
    interrupts_off();
    size_t left = to_send_left;
    to_send_left = 0;
    sending = held_back = false;
    interrupts_on();
    return left;
}

bool usb_sending(void)
{
    return sending;
}
