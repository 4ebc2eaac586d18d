# Images of the sensing nodes: one main, one board each, and a way to make chips.
NODE_BUILD := $(BUILD)/node
NODE_SOURCES := $(addprefix node/,avr.c main.c number.c talk.c) \
	$(addprefix $(CORE)/,crc32.c discipline.c event.c node_memory.c sequencer.c)
NODE_FLAGS := $(STRICT) -Os -flto -ffreestanding -DCRC32_SMALL -DF_CPU=8000000UL \
	-ffunction-sections -fdata-sections -Wl,--gc-sections
NODE_HEADERS := $(wildcard node/*.h $(CORE)/*.h)
NODE_IMAGES := $(addprefix $(NODE_BUILD)/node-,atmega328p.elf atmega328p-fast.elf atmega328p-four.elf attiny85.elf attiny85-data.elf)

.PHONY: node
node: $(NODE_IMAGES) $(NODE_IMAGES:.elf=.hex)

$(NODE_BUILD)/node-atmega328p.elf: node/atmega328p.c node/chips_match.c
$(NODE_BUILD)/node-atmega328p.elf: NODE_MCU := -mmcu=atmega328p
$(NODE_BUILD)/node-atmega328p-fast.elf: node/atmega328p.c node/chips_usart.c
$(NODE_BUILD)/node-atmega328p-fast.elf: NODE_MCU := -mmcu=atmega328p -DNODE_FAST
$(NODE_BUILD)/node-atmega328p-four.elf: node/atmega328p.c node/chips_four.c
$(NODE_BUILD)/node-atmega328p-four.elf: NODE_MCU := -mmcu=atmega328p -DNODE_FOUR
$(NODE_BUILD)/node-attiny85.elf: node/attiny85.c node/chips_match.c
$(NODE_BUILD)/node-attiny85.elf: NODE_MCU := -mmcu=attiny85 -DROWS_ONLY
$(NODE_BUILD)/node-attiny85-data.elf: node/attiny85.c node/chips_match.c
$(NODE_BUILD)/node-attiny85-data.elf: NODE_MCU := -mmcu=attiny85 -DROWS_ONLY -DNODE_DATA

$(NODE_IMAGES): $(NODE_SOURCES) $(NODE_HEADERS)
	@mkdir -p $(@D)
	avr-gcc $(NODE_FLAGS) $(NODE_MCU) $(filter %.c,$^) -o $@
	@avr-size $@ | awk 'NR == 2 {print "$(@F): " $$1 + $$2 " bytes of flash, " $$2 + $$3 " of static RAM"}'

$(NODE_BUILD)/node-%.hex: $(NODE_BUILD)/node-%.elf
	avr-objcopy -O ihex -R .eeprom $< $@
