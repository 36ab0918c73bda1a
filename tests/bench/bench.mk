# Instructions, bytes and times: a part of the Makefile.

.PHONY: bench bench-counts bench-images
BENCH := $(BUILD)/bench
BENCH_C := $(wildcard lib/*.c tests/bench/*.c) $(wildcard port/app/app*.c)
BENCH_H := $(wildcard lib/*.h tests/bench/*.h port/*.h port/app/*.h)
ARM_FAST += tests/bench/%
MAP_cortex-m4f := FLASH_ORIGIN=0x08000000,--defsym=RAM_BYTES=0x20000
# 16 KB more than the part has: the measuring, its records and the judgement take some of it.
MAP_cortex-m0 := FLASH_ORIGIN=0,--defsym=RAM_BYTES=0xC000

bench: setup-dev bench-images firmware-images $(BENCH)/host/O2/bench $(BENCH)/host/O3-avx2/bench
	@$(BIN)/python tests/bench/bench.py --host $(if $(ACCEPT),--accept)

# What is exact, alone.
bench-counts: bench-images firmware-images
	@$(BIN)/python tests/bench/bench.py

# As the core's image has it.
BENCH_FLAGS_cortex-m0 := -DSELFCAL_MODEL_JUDGED=0
BENCH_LINK := arm-none-eabi-gcc -nostartfiles -T tests/bench/image.ld -Wl,--gc-sections
define BENCH_IMAGE
bench-images: $(BENCH)/$(1)/image.elf $(BENCH)/$(1)/module.elf
$(BENCH)/$(1)/selfcal_model.c: $(MODEL)/selfcal_model.c | setup-dev
	$(BIN)/selfcal codegen tools/selfcal/model/models/default.yaml -o $$(@D) --target $(1)
$(BENCH)/$(1)/objects.stamp: $(BENCH_C) $(BENCH_H) $(ARM_SOURCES_$(1)) $(BENCH)/$(1)/selfcal_model.c port/arm.mk \
                             port/library.mk
	@rm -rf $$(@D)/objects
	@$$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(1) MODEL_DIR=$$(@D) OUT=$$(@D)/objects
	$$(call arm_objects,$(ARM_$(1)) $(BENCH_FLAGS_$(1)) -Ilib -Iport -Iport/app -I$$(@D),\
	    $(filter-out lib/%,$(BENCH_C)) $(ARM_SOURCES_$(1)) $$(@D)/selfcal_model.c,$$(@D)/objects)
	@touch $$@
# Either main: the library's in bench.c, the application's in module.c.
$(BENCH)/$(1)/image.elf: LEFT_OUT := module app% more
$(BENCH)/$(1)/module.elf: LEFT_OUT := bench paper_float more
$(BENCH)/$(1)/image.elf $(BENCH)/$(1)/module.elf: $(BENCH)/$(1)/objects.stamp tests/bench/image.ld
	$(BENCH_LINK) $(ARM_$(1)) -Wl,-Map=$$(@:.elf=.map),--defsym=$(MAP_$(1)) \
	    $$(patsubst %,$$(@D)/objects/%.o,$$(filter-out $$(LEFT_OUT),\
	    $(notdir $(BENCH_C:.c=) $(ARM_SOURCES_$(1):.c=)) selfcal_model)) -lm -o $$@
endef
$(eval $(call BENCH_IMAGE,cortex-m4f))
$(eval $(call BENCH_IMAGE,cortex-m0))

# more.c without regressors' code, with it, and with the laws that are sums.
MORE_plain := -DBENCH_PLAIN -DSELFCAL_REGRESSORS_MAX=6
MORE_regressors := -DSELFCAL_REGRESSORS_MAX=6
MORE_sums := -DSELFCAL_TERMS_MAX=3 -DBENCH_SUMS
define BENCH_MORE
bench-images: $(BENCH)/$(1)/$(2).elf
$(BENCH)/$(1)/$(2).elf: $(BENCH_C) $(BENCH_H) $(ARM_SOURCES_$(1)) $(BENCH)/$(1)/selfcal_model.c port/arm.mk \
                        port/library.mk tests/bench/image.ld
	@rm -rf $$(@D)/$(2)
	@$$(MAKE) --no-print-directory -f port/library.mk objects CORE=$(1) MODEL_DIR=$$(@D) OUT=$$(@D)/$(2) \
	    PROGRAM_FLAGS='$(MORE_$(2))'
	$$(call arm_objects,$(ARM_$(1)) $(MORE_$(2)) -Ilib -I$$(@D),\
	    $(addprefix tests/bench/,count.c image.c more.c record.c) $(ARM_SOURCES_$(1)) \
	    $(BENCH)/$(1)/selfcal_model.c,$$(@D)/$(2))
	$(BENCH_LINK) $(ARM_$(1)) -Wl,--defsym=$(MAP_$(1)) $$(@D)/$(2)/*.o -lm -o $$@
endef
$(foreach core,cortex-m4f cortex-m0,$(foreach what,plain regressors sums,$(eval $(call BENCH_MORE,$(core),$(what)))))

$(BENCH)/host/O2/bench: HOST := -O2
$(BENCH)/host/O3-avx2/bench: HOST := -O3 -mavx2 -mfma
$(BENCH)/host/%/bench: tests/bench/host.cpp host_sim/textbook_bank.cpp tests/bench/record.c $(wildcard lib/*.c) \
                       $(MODEL)/selfcal_model.c $(BENCH_H) $(wildcard host_sim/*.hpp)
	@mkdir -p $(@D)
	cd $(@D) && gcc $(HOST) -std=c99 -ffp-contract=off $(WARNINGS) -I$(BACK)/lib -I$(BACK)/$(MODEL) \
	    -c $(filter %.c,$(^:%=$(BACK)/%))
	g++ $(HOST) -std=c++17 $(WARNINGS_DOUBLE) -Ilib -Ihost_sim -I$(MODEL) -isystem /usr/include/eigen3 \
	    $(filter %.cpp,$^) $(@D)/*.o -pthread -o $@
