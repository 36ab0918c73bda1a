# NODE=n on the command line: the module's number on its bus. A variable of that name in the environment is another's.
NODE_FLAGS := $(if $(filter command%,$(origin NODE)),-DSELFCAL_NODE=$(NODE))

# How the library and the application are compiled for the cores; included by whatever builds for one. Sizes, and
# whether samples are processed in integers, stand in the selfcal_config.h beside a model.
ARM_cortex-m4f := -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard
ARM_cortex-m0 := -mcpu=cortex-m0 -mthumb -fconserve-stack
# What every program for a core is linked with, beside the library: floats in software that are faster than libgcc's.
ARM_SOURCES_cortex-m0 := port/cortex-m0/soft_float.c
ARM_WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion -Werror
ARM_COMPILE := -std=c99 -ffp-contract=off -fno-math-errno -ffunction-sections -fdata-sections $(ARM_WARNINGS)
# Every sample, and the cells of a report, run through ARM_FAST. It is compiled for speed, the rest for size: 4 KB
# less. The options of ARM_SMALL save 300 bytes.
ARM_SMALL := -fno-move-loop-invariants -fno-tree-loop-im -fno-tree-tail-merge -fno-reorder-blocks -fno-schedule-insns2 \
             -fno-tree-fre
ARM_FAST := %/intake.c %/intake_fixed.c %/intake_float.c %/bank_kernel_fixed.c %/bank_kernel_float.c \
            %/report_expected.c %/report_spline.c %/report_cells.c
# arm_objects FLAGS,SOURCES,DIR: objects of the sources in DIR. Paths are as given: the path of a checkout, which may
# hold spaces, does not enter.
arm_each = for source in $(2); do $(1) -c $$source -o $(3)/$$(basename $$source .c).o || exit 1; done
arm_objects = $(call arm_each,arm-none-eabi-gcc -O2 $(ARM_COMPILE) $(1),$(filter $(ARM_FAST),$(2)),$(3)); \
	$(call arm_each,arm-none-eabi-gcc -Os $(ARM_SMALL) $(ARM_COMPILE) $(1),\
	    $(filter-out $(ARM_FAST),$(2)),$(3))

# What a replayed recording needs of the application: the board's sensor, with rates of its own, is left out.
APP_WITHOUT_SENSOR := $(filter-out port/app/module.c port/app/readings.c,$(wildcard port/app/*.c))
