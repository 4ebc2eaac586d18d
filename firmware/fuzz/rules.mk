# Fuzzing: one harness per fuzz/fuzz_NAME.c; its kept inputs are test/corpus/firmware_NAME.txt.
#
#   make fuzz COUNT=100000 SEED=1   runs COUNT inputs on each; finds are left in build/fuzz
#   make fuzz-harnesses             builds the harnesses, with libFuzzer if it is installed:
#   make fuzz-libfuzzer             builds them with clang and libFuzzer, guided by coverage
#   make fuzz-standalone            builds them with any compiler and a main() of their own
#
# To keep a find: python -m torture.fuzz.corpus add firmware_NAME FILE…

FUZZ_OUT := $(BUILD)/fuzz
FUZZ_UNPACK := python3 ../torture/fuzz/corpus.py unpack
FUZZ_NAMES := framing setup digitizer demonstrator node kernel stream sparse $(if $(wildcard /usr/include/simavr/sim_avr.h),board)
# The driver's, which this Makefile does not build otherwise:
FUZZ_KERNEL := $(basename $(notdir $(wildcard ../kernel/*.c)))
FUZZ_SOURCES := $(addprefix fuzz/,commands.c framing.c host.c line.c settings.c) $(wildcard $(CORE)/*.c)
FUZZ_HEADERS := $(wildcard fuzz/*.h sim/*.h $(CORE)/*.h ../kernel/*.h) fuzz/rules.mk
# -g1: lines for the sanitizers' reports; gcc takes nine times as long to follow variables, too.
FUZZ_CFLAGS := $(STRICT) -I fuzz -I sim -I ../kernel -O1 -g1 -fno-omit-frame-pointer
# Compiled by -O0: -O1 unrolls them, and with sanitizers clang takes 12 s then, not 1, for the first.
FUZZ_UNROLLED := kernel_sources/transform.o kernel_sources/words.o fuzz/fuzz_kernel.o
FUZZ_SANITIZE := -fsanitize=address,undefined -fno-sanitize-recover=undefined
FUZZ_RUNTIME := $(shell clang -print-runtime-dir 2>/dev/null)
FUZZ_KIND := $(if $(wildcard $(FUZZ_RUNTIME)/libclang_rt.fuzzer*),libfuzzer,standalone)
COUNT ?= 100000
SEED ?= 1

.PHONY: fuzz fuzz-harnesses fuzz-libfuzzer fuzz-standalone
fuzz-harnesses: fuzz-$(FUZZ_KIND)
fuzz: fuzz-harnesses
	@set -e; for name in $(FUZZ_NAMES); do \
	    echo "$$name: $(COUNT) inputs"; mkdir -p $(FUZZ_OUT)/corpus/$$name; \
	    $(FUZZ_UNPACK) firmware_$$name $(FUZZ_OUT)/kept/$$name; \
	    $(FUZZ_OUT)/$(FUZZ_KIND)/$$name -runs=$(COUNT) -seed=$(SEED) $(FUZZ_OPTIONS_$(FUZZ_KIND)) \
	        $(FUZZ_OUT)/corpus/$$name $(FUZZ_OUT)/kept/$$name; \
	done
FUZZ_OPTIONS_libfuzzer = -artifact_prefix=$(FUZZ_OUT)/found-$$name- -verbosity=0

# What is built: kind; compiler and its option for objects; what is linked besides
define fuzz_kind
.PRECIOUS: $$(FUZZ_OUT)/$(1)/%.o
fuzz-$(1): $$(FUZZ_NAMES:%=$$(FUZZ_OUT)/$(1)/%)

$$(FUZZ_OUT)/$(1)/%.o: %.c $$(FUZZ_HEADERS)
	@mkdir -p $$(@D)
	$(2) $$(FUZZ_CFLAGS) $$(FUZZ_SANITIZE) $(3) -c $$< -o $$@

$$(FUZZ_OUT)/$(1)/kernel_sources/%.o: ../kernel/%.c $$(FUZZ_HEADERS)
	@mkdir -p $$(@D)
	$(2) $$(FUZZ_CFLAGS) $$(FUZZ_SANITIZE) $(3) -c $$< -o $$@

$$(FUZZ_UNROLLED:%=$$(FUZZ_OUT)/$(1)/%): FUZZ_CFLAGS += -O0
$$(FUZZ_OUT)/$(1)/kernel $$(FUZZ_OUT)/$(1)/stream $$(FUZZ_OUT)/$(1)/sparse: $$(FUZZ_KERNEL:%=$$(FUZZ_OUT)/$(1)/kernel_sources/%.o)
$$(FUZZ_OUT)/$(1)/board: $$(patsubst sim/%.c,$$(FUZZ_OUT)/$(1)/sim/%.o,$$(wildcard sim/*.c))
$$(FUZZ_OUT)/$(1)/%: $$(FUZZ_OUT)/$(1)/fuzz/fuzz_%.o $$(FUZZ_SOURCES:%.c=$$(FUZZ_OUT)/$(1)/%.o) $(5)
	$(2) $$(FUZZ_SANITIZE) $(4) $$(filter %.o,$$^) -o $$@ $$(if $$(filter board,$$*),-lsimavr -lelf) -lm
endef
$(eval $(call fuzz_kind,libfuzzer,clang,-fsanitize=fuzzer-no-link,-fsanitize=fuzzer))
$(eval $(call fuzz_kind,standalone,$$(CC),,,$$(FUZZ_OUT)/standalone/fuzz/standalone.o))
