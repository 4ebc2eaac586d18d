# build/rp2040/digitizer.elf, .bin and .uf2, and demo.*: the demonstrator, which brings its nodes with it
RP2040_DIR := digitizer/rp2040
RP2040_OUT := $(BUILD)/rp2040
RP2040_CC := arm-none-eabi-gcc
RP2040_FLAGS := -mcpu=cortex-m0plus -mthumb -O2 -g -ffunction-sections -fdata-sections
RP2040_CORE := loop digitizer setup stream pull pulses packet cobs crc32
RP2040_DEMO_CORE := demonstrator node_memory event sequencer
RP2040_DIGITIZER := nodes_elsewhere
RP2040_SHARED := $(filter-out $(RP2040_DIGITIZER),$(basename $(notdir $(wildcard $(RP2040_DIR)/*.c))))
RP2040_OBJECTS := $(addprefix $(RP2040_OUT)/,$(addsuffix .o,$(RP2040_CORE:%=core/%) $(RP2040_SHARED) boot2))
RP2040_HEADERS := $(wildcard $(CORE)/*.h $(RP2040_DIR)/*.h $(RP2040_DIR)/demo/*.h) $(RP2040_DIR)/rules.mk

.PRECIOUS: $(RP2040_OUT)/%.o $(RP2040_OUT)/core/%.o $(RP2040_OUT)/%.elf $(RP2040_OUT)/%-linked.bin
rp2040: $(RP2040_OUT)/digitizer.uf2 $(RP2040_OUT)/demo.uf2

$(RP2040_OUT)/digitizer.elf: $(RP2040_DIGITIZER:%=$(RP2040_OUT)/%.o)
$(RP2040_OUT)/demo.elf: $(RP2040_DEMO_CORE:%=$(RP2040_OUT)/core/%.o) $(RP2040_OUT)/demo/nodes_here.o \
    $(RP2040_OUT)/demo/pins.o

$(RP2040_OUT)/%.uf2: $(RP2040_OUT)/%-linked.bin $(RP2040_DIR)/image.py
	python3 $(RP2040_DIR)/image.py $< $(@:.uf2=.bin) $@

$(RP2040_OUT)/%-linked.bin: $(RP2040_OUT)/%.elf
	arm-none-eabi-objcopy -O binary $< $@

$(RP2040_OUT)/%.elf: $(RP2040_OBJECTS) $(RP2040_DIR)/rp2040.ld
	$(RP2040_CC) $(RP2040_FLAGS) -nostartfiles -Wl,--gc-sections -Wl,--fatal-warnings \
	    -T $(RP2040_DIR)/rp2040.ld $(filter %.o,$^) -o $@
	@arm-none-eabi-size $@

$(RP2040_OUT)/core/%.o: $(CORE)/%.c $(wildcard $(CORE)/*.h) $(RP2040_DIR)/rules.mk
	@mkdir -p $(@D)
	$(RP2040_CC) $(RP2040_FLAGS) $(STRICT) -c $< -o $@

$(RP2040_OUT)/%.o: $(RP2040_DIR)/%.c $(RP2040_HEADERS)
	@mkdir -p $(@D)
	$(RP2040_CC) $(RP2040_FLAGS) $(STRICT) -I $(RP2040_DIR) -c $< -o $@

$(RP2040_OUT)/%.o: $(RP2040_DIR)/%.S
	@mkdir -p $(@D)
	$(RP2040_CC) $(RP2040_FLAGS) -c $< -o $@
