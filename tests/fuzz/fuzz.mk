# Random calls of the library: a part of the Makefile.

# Small grids and batches: an execution is some 0.2 ms. trace-cmp finds magic numbers, which the harness has none of.
.PHONY: fuzz
KERNEL ?= float
FUZZ := $(BUILD)/fuzz/$(KERNEL)
FUZZ_SIZES := -DSELFCAL_AXES_MAX=3 -DSELFCAL_TERMS_MAX=3 -DSELFCAL_HYPOTHESES_MAX=6 -DSELFCAL_GRID_MAX=6 \
    -DSELFCAL_BATCH=8 -DSELFCAL_REPORT_QUALITY=0 -DSELFCAL_ALPHA_MAX=6 -DSELFCAL_HYPOTHESIS_NODES_MAX=36 \
    -DSELFCAL_NODES_MAX=216 -DSELFCAL_RETIRE_BLOCKS=4 -DSELFCAL_REGRESSORS_MAX=2
RUNS ?= 10000000

# RUNS executions, or SECONDS seconds, beginning with the inputs found before. A failing input is left in
# build/fuzz/KERNEL: run fuzz_api there on it.
fuzz: $(FUZZ)/fuzz_api
	@mkdir -p $(FUZZ)/corpus
	ASAN_OPTIONS=quarantine_size_mb=1:detect_leaks=0 $(FUZZ)/fuzz_api -max_len=400 -timeout=20 \
	    -artifact_prefix=$(FUZZ)/ -print_final_stats=1 -entropic=0 -verbosity=0 \
	    $(if $(SECONDS),-max_total_time=$(SECONDS),-runs=$(RUNS)) $(FUZZ)/corpus tests/fuzz/found

# -march=native: fused multiply-adds are no calls.
$(BUILD)/fuzz/%/fuzz_api: tests/fuzz/fuzz_api.c $(wildcard lib/*.[ch]) | $(MODEL)/selfcal_model.c setup-dev
	@mkdir -p $(@D)
	clang -std=c99 -O2 -g -march=native -ffp-contract=off -Ilib -I$(MODEL) $(FUZZ_SIZES) \
	    $(patsubst fixed,-DSELFCAL_FIXED,$(filter fixed,$*)) \
	    '-DSELFCAL_ASSERT(condition)=((condition) ? (void)0 : __builtin_trap())' \
	    -fsanitize=fuzzer,address,undefined,float-cast-overflow -fno-sanitize-recover=all \
	    -fno-sanitize-coverage=trace-cmp $(filter %.c,$^) -lm -o $@
