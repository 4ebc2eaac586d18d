// SPDX-License-Identifier: Apache-2.0

/* The part common to both microcontrollers: converter, LED, EEPROM. */
#include "node_board.h"
#include "doze.h"

#include <avr/eeprom.h>

EMPTY_INTERRUPT(ADC_vect)

/* One conversion, asleep. Its clock is 8 MHz / 64 = 125 kHz; the data sheet asks for 50 to 200 kHz. */
static uint16_t convert(void)
{
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1);
    for (;;) {
        cli();
        if (!(ADCSRA & _BV(ADSC)))
            break;
        doze();
    }
    sei();
    return ADC;
}

uint16_t board_measure(uint8_t sensor)
{
    uint16_t reading;

    if (BOARD_SENSORS > 1)
        ADMUX = (uint8_t)((ADMUX & 0xF0u) | sensor);
    if (BOARD_SENSORS == 1 || !(ADCSRA & _BV(ADEN)))
        convert(); /* the first conversion after power-on of the converter is inaccurate: discarded */
    reading = convert();
    if (BOARD_SENSORS == 1)
        ADCSRA = 0; /* of several it stays on: there is no time to discard one in every frame */
    return reading;
}

void board_led(bool on)
{
    if (!board_has_led())
        return;
    if (board_on_data() && on)
        PORTB |= _BV(BOARD_SYNC);
    else if (board_on_data())
        PORTB &= (uint8_t)~_BV(BOARD_SYNC);
    else if (on)
        BOARD_LED_PORT |= _BV(BOARD_LED);
    else
        BOARD_LED_PORT &= (uint8_t)~_BV(BOARD_LED);
}

uint8_t board_memory_byte(uint16_t address)
{
    return eeprom_read_byte((const uint8_t *)address);
}

void board_memory_write(uint16_t address, uint8_t byte)
{
    eeprom_update_byte((uint8_t *)address, byte);
}
