# NODE=n on the command line: the module's number on its bus. A variable of that name in the environment is another's.
NODE_FLAGS := $(if $(filter command%,$(origin NODE)),-DSELFCAL_NODE=$(NODE))

# How the library and the application are compiled for the cores; included by whatever builds for one. SELFCAL_GRID_MAX,
# SELFCAL_ALPHA_MAX, SELFCAL_HYPOTHESIS_NODES_MAX, SELFCAL_NODES_MAX: as the core's nodes in the default model are.
CONFIG_cells := -DSELFCAL_REPORT_CELLS=24 -DSELFCAL_SIGMA_CELLS=24 -DSELFCAL_HISTOGRAM=64 -DSELFCAL_LINES=32
CONFIG_cortex-m4f := $(CONFIG_cells) -DSELFCAL_GRID_MAX=16 -DSELFCAL_ALPHA_MAX=12 \
                     -DSELFCAL_HYPOTHESIS_NODES_MAX=192 -DSELFCAL_NODES_MAX=209
# Integers; a node's batch takes 4 sample periods at 819.2 Hz and 48 MHz. As many lines as the RAM has room for: they do
# for 5000 bank samples.
CONFIG_cortex-m0 := -DSELFCAL_REPORT_CELLS=24 -DSELFCAL_SIGMA_CELLS=24 -DSELFCAL_HISTOGRAM=64 -DSELFCAL_LINES=20 \
	-DSELFCAL_GRID_MAX=16 -DSELFCAL_ALPHA_MAX=7 -DSELFCAL_HYPOTHESIS_NODES_MAX=98 -DSELFCAL_NODES_MAX=115 \
                    -DSELFCAL_HYPOTHESES_MAX=3 -DSELFCAL_FIXED=16 -DSELFCAL_PUSH_EVERY=16
ARM_cortex-m4f-portable := -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard $(CONFIG_cortex-m4f)
ARM_cortex-m4f := $(ARM_cortex-m4f-portable) -DSELFCAL_KERNEL_M4F
ARM_cortex-m0 := -mcpu=cortex-m0 -mthumb -fconserve-stack $(CONFIG_cortex-m0)
ARM_cortex-m0-32bit := -mcpu=cortex-m0 -mthumb -fconserve-stack -DSELFCAL_FIXED=32 \
                       $(filter-out -DSELFCAL_FIXED=% -DSELFCAL_PUSH_EVERY=%,$(CONFIG_cortex-m0))
ARM_WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion -Werror
ARM_COMPILE := -std=c99 -ffp-contract=off -fno-math-errno -ffunction-sections -fdata-sections $(ARM_WARNINGS)
# Every sample runs through ARM_FAST, which is compiled for speed, the rest for size: 4 KB less, 3 % more instructions
# in a report. Beside the assembly the kernel in C runs seldom. The options of ARM_SMALL save 300 bytes.
ARM_SMALL := -fno-move-loop-invariants -fno-tree-loop-im -fno-tree-tail-merge -fno-reorder-blocks -fno-schedule-insns2 \
             -fno-tree-fre
ARM_FAST := %/averager.c %/averager_fixed.c %/kernel_fixed.c %/kernel_float.c
arm_fast = $(filter $(if $(findstring KERNEL_M4F,$(1)),$(filter-out %/kernel_float.c,$(ARM_FAST)),$(ARM_FAST)),$(2))
# arm_objects FLAGS,SOURCES,DIR: objects of the sources in DIR. Paths are as given: the path of a checkout, which may
# hold spaces, does not enter.
arm_each = for source in $(2); do $(1) -c $$source -o $(3)/$$(basename $$source .c).o || exit 1; done
arm_objects = $(call arm_each,arm-none-eabi-gcc -O2 $(ARM_COMPILE) $(1),$(call arm_fast,$(1),$(2)),$(3)); \
	$(call arm_each,arm-none-eabi-gcc -Os $(ARM_SMALL) $(ARM_COMPILE) $(1),\
	    $(filter-out $(call arm_fast,$(1),$(2)),$(2)),$(3))

# What a replayed recording needs of the application: the board's sensor, with rates of its own, is left out.
APP_WITHOUT_SENSOR := $(filter-out port/app/module.c port/app/sensor.c,$(wildcard port/app/*.c))
