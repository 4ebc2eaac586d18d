// SPDX-License-Identifier: Apache-2.0

/* USB descriptors of the device. */
#ifndef RP2040_USB_DESCRIPTORS_H
#define RP2040_USB_DESCRIPTORS_H

#include <stdint.h>

#define USB_PACKET 64 /* bytes per packet, except for notifications */

enum usb_endpoint { EP_CONTROL, EP_NOTIFY, EP_DATA };
enum usb_type { USB_CONTROL, USB_ISOCHRONOUS, USB_BULK, USB_INTERRUPT };
enum usb_descriptor { USB_DEVICE = 1, USB_CONFIGURATION = 2, USB_STRING = 3 };
enum usb_string { USB_LANGUAGES, USB_MANUFACTURER, USB_PRODUCT, USB_SERIAL };

#define LE16(value) (value) & 0xff, (value) >> 8
#define IN(endpoint) ((endpoint) | 0x80)
#define CONFIGURATION_SIZE 75
#define CONFIGURATION_MAX_POWER 8 /* place of the current from USB, 2 mA; written at power-up */

static const uint8_t device_descriptor[] = {
    18, USB_DEVICE, LE16(0x0200),
    0xef, 2, 1,                   /* several functions with association descriptors */
    USB_PACKET,
    LE16(0x1209), LE16(0x0001),   /* pid.codes, for tests: get your own before selling boards */
    LE16(0x0100), USB_MANUFACTURER, USB_PRODUCT, USB_SERIAL,
    1,
};

static uint8_t configuration_descriptor[] = {
    9, USB_CONFIGURATION, LE16(CONFIGURATION_SIZE), 2, 1, 0, 0x80, 0,
    8, 11, 0, 2, 2, 2, 0, 0,                    /* interfaces 0 and 1 are one function: CDC ACM */
    9, 4, 0, 0, 1, 2, 2, 0, 0,                  /* interface 0: its control */
    5, 0x24, 0, LE16(0x0110),                   /* CDC 1.1 */
    5, 0x24, 1, 0, 1,                           /* no call management; data on interface 1 */
    4, 0x24, 2, 2,                              /* line coding and state */
    5, 0x24, 6, 0, 1,                           /* union of 0 and 1 */
    7, 5, IN(EP_NOTIFY), USB_INTERRUPT, LE16(8), 255,
    9, 4, 1, 0, 2, 10, 0, 0, 0,                 /* interface 1: its data */
    7, 5, EP_DATA, USB_BULK, LE16(USB_PACKET), 0,
    7, 5, IN(EP_DATA), USB_BULK, LE16(USB_PACKET), 0,
};
_Static_assert(sizeof configuration_descriptor == CONFIGURATION_SIZE, "length in its header");

#endif
