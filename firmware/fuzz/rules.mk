# Fuzzing: a harness for each fuzz/fuzz_NAME.c; seeds and found cases are test/corpus/firmware_NAME.
#
#   make fuzz COUNT=100000 SEED=1   so many inputs to each; what is found is left in build/fuzz
#   make fuzz-harnesses             the harnesses, by the best way that is there:
#   make fuzz-libfuzzer             the harnesses, by clang with libFuzzer: guided by coverage
#   make fuzz-standalone            the harnesses, by any compiler, with a main() of their own

FUZZ_OUT := $(BUILD)/fuzz
FUZZ_CORPUS := ../test/corpus
FUZZ_NAMES := framing setup digitizer node $(if $(wildcard /usr/include/simavr/sim_avr.h),board)
FUZZ_SOURCES := $(addprefix fuzz/,commands.c framing.c host.c line.c settings.c) $(wildcard $(CORE)/*.c)
FUZZ_HEADERS := $(wildcard fuzz/*.h sim/*.h $(CORE)/*.h) fuzz/rules.mk
FUZZ_CFLAGS := $(STRICT) -I fuzz -I sim -O1 -g -fno-omit-frame-pointer
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
	    $(FUZZ_OUT)/$(FUZZ_KIND)/$$name -runs=$(COUNT) -seed=$(SEED) $(FUZZ_OPTIONS_$(FUZZ_KIND)) \
	        $(FUZZ_OUT)/corpus/$$name $(FUZZ_CORPUS)/firmware_$$name; \
	done
FUZZ_OPTIONS_libfuzzer = -artifact_prefix=$(FUZZ_OUT)/found-$$name- -verbosity=0

# What is built: kind; compiler and its option for objects; what is linked besides
define fuzz_kind
.PRECIOUS: $$(FUZZ_OUT)/$(1)/%.o
fuzz-$(1): $$(FUZZ_NAMES:%=$$(FUZZ_OUT)/$(1)/%)

$$(FUZZ_OUT)/$(1)/%.o: %.c $$(FUZZ_HEADERS)
	@mkdir -p $$(@D)
	$(2) $$(FUZZ_CFLAGS) $$(FUZZ_SANITIZE) $(3) -c $$< -o $$@

$$(FUZZ_OUT)/$(1)/board: $$(patsubst sim/%.c,$$(FUZZ_OUT)/$(1)/sim/%.o,$$(wildcard sim/*.c))
$$(FUZZ_OUT)/$(1)/%: $$(FUZZ_OUT)/$(1)/fuzz/fuzz_%.o $$(FUZZ_SOURCES:%.c=$$(FUZZ_OUT)/$(1)/%.o) $(5)
	$(2) $$(FUZZ_SANITIZE) $(4) $$(filter %.o,$$^) -o $$@ $$(if $$(filter board,$$*),-lsimavr -lelf -lm)
endef
$(eval $(call fuzz_kind,libfuzzer,clang,-fsanitize=fuzzer-no-link,-fsanitize=fuzzer))
$(eval $(call fuzz_kind,standalone,$$(CC),,,$$(FUZZ_OUT)/standalone/fuzz/standalone.o))
