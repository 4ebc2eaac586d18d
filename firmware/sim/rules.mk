# The emulated skin: real node images under simavr, the analog line, the digitizer's core on virtual
# hardware. One shared library, for emulated.py.

SIM_OUT := $(BUILD)/sim
SIM_SOURCES := $(wildcard sim/*.c $(CORE)/*.c)
SIM_HEADERS := $(wildcard sim/*.h $(CORE)/*.h)

sim: $(SIM_OUT)/libskin.so

$(SIM_OUT)/libskin.so: $(SIM_SOURCES) $(SIM_HEADERS)
	@mkdir -p $(@D)
	$(CC) $(STRICT) -O2 -g -fPIC -shared $(SIM_SOURCES) -o $@ -lsimavr -lelf -lm
