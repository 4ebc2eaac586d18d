# Fuzzing: harness fuzz/fuzz_NAME.c, seeds and found cases in test/corpus/firmware_NAME.
#
#   make fuzz COUNT=1000000 SEED=1   so many inputs for each; what is found is left in build/fuzz
#   make fuzz-libfuzzer              the harnesses by clang with libFuzzer, guided by coverage …
#   make fuzz-standalone             … and by the usual compiler with a main() of their own

FUZZ_OUT := $(BUILD)/fuzz
FUZZ_CORPUS := ../test/corpus
FUZZ_NAMES := framing setup digitizer node board
FUZZ_HELPERS := $(addprefix fuzz/,commands.c framing.c host.c line.c settings.c)
FUZZ_CORE := $(filter-out $(CORE)/sequencer.c,$(wildcard $(CORE)/*.c)) $(CORE)/sequencer.c
FUZZ_HEADERS := $(wildcard fuzz/*.h sim/*.h $(CORE)/*.h) fuzz/rules.mk
FUZZ_CFLAGS := $(STRICT) -I fuzz -I sim -O1 -g -fno-omit-frame-pointer -fno-sanitize-recover=undefined
FUZZ_BOARD := $(filter-out sim/check.c,$(wildcard sim/*.c))
FUZZ_BOARD_LIBRARIES := -lsimavr -lelf -lm
