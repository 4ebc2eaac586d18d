# Images of the sensing nodes: one main, one board each.
NODE_BUILD := $(BUILD)/node
NODE_CORE := crc32 discipline event node_memory sequencer
NODE_OWN := avr main talk
NODE_MCUS := atmega328p attiny85
NODE_FLAGS := $(STRICT) -Os -flto -ffreestanding -DCRC32_SMALL -DF_CPU=8000000UL \
	-ffunction-sections -fdata-sections -Wl,--gc-sections
NODE_HEADERS := $(wildcard node/*.h $(CORE)/*.h)
NODE_IMAGES := $(NODE_MCUS:%=$(NODE_BUILD)/node-%.elf)

.PHONY: node
node: $(NODE_IMAGES) $(NODE_IMAGES:.elf=.hex)

$(NODE_BUILD)/node-%.elf: node/%.c $(NODE_OWN:%=node/%.c) $(NODE_CORE:%=$(CORE)/%.c) $(NODE_HEADERS)
	@mkdir -p $(@D)
	avr-gcc $(NODE_FLAGS) -mmcu=$* $(filter %.c,$^) -o $@
	@avr-size -C --mcu=$* $@ | grep -E '^(Program|Data)' | sed 's/^/$*: /'

$(NODE_BUILD)/node-%.hex: $(NODE_BUILD)/node-%.elf
	avr-objcopy -O ihex -R .eeprom $< $@
