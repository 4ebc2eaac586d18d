// SPDX-License-Identifier: Apache-2.0

/* Small programs whose timing is known, for the tests of the emulator: a node's pins. Which one is
 * built is chosen by -DSPECIMEN_name. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <util/delay_basic.h>

#define OUT 1 /* of port B */
#if defined(__AVR_ATtiny85__)
#define SYNC 2
#define SYNC_VECTOR INT0_vect
#define LED_DDR DDRB
#define LED_PORT PORTB
#define LED 4
#define SENSOR 3
#define TIMER1_MASK TIMSK
#define TIMER1_FLAGS TIFR
#define MODE(mode) (TCCR1 = (uint8_t)(_BV(CS11) | (mode) << COM1A0))
#define FORCE() (GTCCR = _BV(FOC1A))
#define STEP 200 /* of 2 cycles */
#else
#define SYNC 0
#define SYNC_VECTOR TIMER1_CAPT_vect
#define LED_DDR DDRD
#define LED_PORT PORTD
#define LED 7
#define SENSOR 0
#define TIMER1_MASK TIMSK1
#define TIMER1_FLAGS TIFR1
#define MODE(mode) (TCCR1A = (uint8_t)((mode) << COM1A0))
#define FORCE() (TCCR1C = _BV(FOC1A))
#define STEP 400
#endif
enum { NONE, TOGGLE, CLEAR, SET }; /* of output compare A */

/* Timer1 runs, and the sync line's next edge (ATmega: a rising one) interrupts. */
static inline void listen(void)
{
#if defined(__AVR_ATtiny85__)
    TCCR1 = _BV(CS11); /* CK/2 */
    MCUCR |= _BV(ISC00);
    GIMSK = _BV(INT0);
#else
    TCCR1B = _BV(CS10) | _BV(ICES1);
    TIMSK1 = _BV(ICIE1);
#endif
}

static inline void wait_for_sync(void)
{
    loop_until_bit_is_clear(PINB, SYNC);
    loop_until_bit_is_set(PINB, SYNC);
}

/* A pulse whose length grows by 4 cycles per one. */
static inline void show(uint16_t value)
{
    PORTB |= _BV(OUT);
    _delay_loop_2((uint16_t)(value + 1));
    PORTB &= (uint8_t)~_BV(OUT);
}

static inline void sleep_on(void)
{
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    for (;;)
        sleep_mode();
}

#ifdef SPECIMEN_capture
/* Copies the sync line to the output, 201 cycles later, by input capture and output compare. */

ISR(TIMER1_CAPT_vect)
{
    OCR1A = ICR1 + 200;
    TCCR1A = TCCR1B & _BV(ICES1) ? _BV(COM1A1) | _BV(COM1A0) : _BV(COM1A1);
    TCCR1B ^= _BV(ICES1);
}

int main(void)
{
    DDRB = _BV(OUT);
    listen();
#ifdef AWAKE
    sei();
    for (;;)
        __asm__ volatile("call 0f\n0: pop r0\n pop r0"); /* instructions of up to 4 cycles */
#else
    sleep_on();
#endif
}
#endif

#ifdef SPECIMEN_cleared
/* Clears the sync line's flag at each of CLEARED edges, before it interrupts. A pulse at each interrupt
 * after that: there should be one, of Timer1. */

#if defined(__AVR_ATtiny85__)
#define SYNC_FLAGS GIFR
#define SYNC_FLAG INTF0
#else
#define SYNC_FLAGS TIFR1
#define SYNC_FLAG ICF1
#endif

ISR(SYNC_VECTOR)
{
    show(1);
}

ISR(TIMER1_COMPB_vect)
{
    TIMER1_MASK = 0;
    show(1);
}

int main(void)
{
    DDRB = _BV(OUT);
    OCR1B = 100;
    listen();
    for (uint8_t i = 0; i < CLEARED; i++) {
        loop_until_bit_is_set(SYNC_FLAGS, SYNC_FLAG);
        SYNC_FLAGS = _BV(SYNC_FLAG);
    }
    TIMER1_MASK |= _BV(OCIE1B);
    sleep_on();
}
#endif

#ifdef SPECIMEN_convert
/* At every sync pulse shows what the converter reads. */

int main(void)
{
    DDRB = _BV(OUT);
#if defined(__AVR_ATtiny85__)
    ADMUX = SENSOR; /* reference Vcc */
#else
    ADMUX = _BV(REFS0) | SENSOR; /* reference AVcc */
#endif
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1);
    for (;;) {
        wait_for_sync();
        ADCSRA |= _BV(ADSC);
        loop_until_bit_is_clear(ADCSRA, ADSC);
        show(ADC);
    }
}
#endif

#ifdef SPECIMEN_flags
/* A pulse if an interrupt flag clears alone; another at once if one that is set interrupts when it
 * is enabled. */

ISR(TIMER1_COMPB_vect)
{
    show(1);
}

int main(void)
{
    DDRB = _BV(OUT);
    OCR1A = 100;
    OCR1B = 100;
    listen();
    TIMER1_MASK = 0;
    loop_until_bit_is_set(TIMER1_FLAGS, OCF1A);
    TIMER1_FLAGS = _BV(OCF1A);
    if (!(TIMER1_FLAGS & _BV(OCF1A)) && TIMER1_FLAGS & _BV(OCF1B))
        show(1);
    TIMER1_MASK = _BV(OCIE1B);
    sleep_on();
}
#endif

#ifdef SPECIMEN_hang
/* Drives its output as the latch is, forces that high, takes no care of the watchdog (16 ms), and
 * lights the LED after a reset by it. */
#include <avr/wdt.h>


int main(void)
{
    if (MCUSR & _BV(WDRF)) {
        LED_DDR |= _BV(LED);
        LED_PORT |= _BV(LED);
    }
    wdt_enable(WDTO_15MS);
    OCR1A = 255; /* no match in the meantime */
    MODE(SET);
    DDRB |= _BV(OUT);
    FORCE();
    for (;;)
        ;
}
#endif

#ifdef SPECIMEN_latch
/* Output compare A: forced, toggled by matches every 400 cycles, disconnected, and set for good. */

static uint16_t matches;

ISR(TIMER1_COMPA_vect)
{
    OCR1A += STEP;
    if (++matches == 9)
        MODE(NONE); /* the PORT bit, which is low */
    if (matches == 10)
        MODE(SET); /* from now on it stays high */
}

int main(void)
{
    listen();
    TIMER1_MASK = _BV(OCIE1A);
    MODE(SET);
    FORCE(); /* while released */
    DDRB = _BV(OUT);
    MODE(CLEAR);
    FORCE();
    MODE(SET); /* nothing yet */
    MODE(TOGGLE);
    OCR1A = 200;
    TIMER1_FLAGS = _BV(OCF1A);
    sleep_on();
}
#endif

#ifdef SPECIMEN_levels
/* Every state of the output pin, 10 cycles each; released into its pull-up last. */

int main(void)
{
    LED_DDR |= _BV(LED);
    LED_PORT |= _BV(LED);
    __asm__ volatile("sbi %0, %2\n" /* low */
                     ".rept 8\n nop\n .endr\n"
                     "sbi %1, %2\n" /* high */
                     ".rept 8\n nop\n .endr\n"
                     "cbi %1, %2\n" /* low */
                     ".rept 8\n nop\n .endr\n"
                     "cbi %0, %2\n" /* released */
                     ".rept 8\n nop\n .endr\n"
                     "sbi %1, %2\n" /* pulled up */ ::"I"(_SFR_IO_ADDR(DDRB)),
                     "I"(_SFR_IO_ADDR(PORTB)), "I"(OUT));
    for (;;)
        ;
}
#endif

#ifdef SPECIMEN_memory
/* At every sync pulse shows the next byte of its EEPROM. */
#include <avr/eeprom.h>


int main(void)
{
    DDRB = _BV(OUT);
    for (uint8_t *byte = 0;; byte++) {
        wait_for_sync();
        show(eeprom_read_byte(byte));
    }
}
#endif

#ifdef SPECIMEN_reheard
/* Copies the sync line to its output until the watchdog (16 ms) resets it, again and again. */
#include <avr/wdt.h>


int main(void)
{
    wdt_enable(WDTO_15MS);
    DDRB = _BV(OUT);
    for (;;) {
        if (PINB & _BV(SYNC))
            PORTB |= _BV(OUT);
        else
            PORTB &= (uint8_t)~_BV(OUT);
    }
}
#endif

#ifdef SPECIMEN_release
/* Released some 200 cycles after Timer1 starts; a match sets the latch, high until then, low: when,
 * byte 0 of the EEPROM says in cycles. */
#include <avr/eeprom.h>


int main(void)
{
    OCR1A = (uint16_t)(180 + eeprom_read_byte(0));
    TCCR1A = _BV(COM1A1) | _BV(COM1A0);
    TCCR1C = _BV(FOC1A);
    TCCR1A = _BV(COM1A1);
    DDRB = _BV(OUT);
    TCCR1B = _BV(CS10);
    _delay_loop_1(64);
    DDRB = 0;
    for (;;)
        ;
}
#endif

#ifdef SPECIMEN_respond
/* An interrupt makes a pulse, with its first instructions. */

ISR(SYNC_VECTOR, ISR_NAKED)
{
    __asm__ volatile("sbi %0, %1\n cbi %0, %1\n reti" ::"I"(_SFR_IO_ADDR(PORTB)), "I"(OUT));
}

int main(void)
{
    DDRB = _BV(OUT);
    listen();
    sleep_on();
}
#endif

#ifdef SPECIMEN_wrong
/* What the emulator cannot follow, or no node should do: a deep sleep, a read beyond the EEPROM. */
#include <avr/eeprom.h>


int main(void)
{
    GPIOR0 = eeprom_read_byte((const uint8_t *)E2END + 1);
    sleep_cpu(); /* not enabled: nothing */
    set_sleep_mode(SLEEP_MODE_PWR_DOWN);
    for (;;)
        sleep_mode();
}
#endif
