# The digitizer's core on recorded events, as a program for this machine, and as one for an RP2040's
# instruction set that runs in QEMU (test/firmware/test_core_replay.py says how).

REPLAY := digitizer/replay
REPLAY_OUT := $(BUILD)/replay
REPLAY_CORE := $(addprefix $(CORE)/,digitizer.c setup.c stream.c pull.c pulses.c packet.c cobs.c crc32.c)
REPLAY_HEADERS := $(wildcard $(CORE)/*.h $(REPLAY)/*.h) $(REPLAY)/rules.mk
REPLAY_CFLAGS := $(STRICT) -O2 -g
REPLAY_ARM := arm-none-eabi-gcc -mcpu=cortex-m0plus -mthumb --specs=rdimon.specs

.PHONY: replay-native replay-arm
replay: replay-native $(if $(shell command -v arm-none-eabi-gcc),replay-arm)
replay-native: $(REPLAY_OUT)/replay
replay-arm: $(REPLAY_OUT)/replay.elf

$(REPLAY_OUT):
	mkdir -p $@

$(REPLAY_OUT)/replay: $(REPLAY)/replay.c $(REPLAY_CORE) $(REPLAY_HEADERS) | $(REPLAY_OUT)
	$(CC) $(REPLAY_CFLAGS) $(filter %.c,$^) -o $@

$(REPLAY_OUT)/replay.elf: $(REPLAY)/replay.c $(REPLAY)/mps2.c $(REPLAY_CORE) $(REPLAY)/mps2.ld \
		$(REPLAY_HEADERS) | $(REPLAY_OUT)
	$(REPLAY_ARM) $(REPLAY_CFLAGS) -T $(REPLAY)/mps2.ld $(filter %.c,$^) -o $@
