# How the library and the application are compiled for the cores; included by whatever builds for one.
ARM_cortex-m4f-portable := -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard
ARM_cortex-m4f := $(ARM_cortex-m4f-portable) -DSELFCAL_KERNEL_M4F
# Integers; a node's batch takes 4 sample periods at 819.2 Hz and 48 MHz; the largest grid dimension of nodes.cortex-m0 is 8.
ARM_cortex-m0 := -mcpu=cortex-m0 -mthumb -DSELFCAL_FIXED=16 -DSELFCAL_PUSH_EVERY=16 -DSELFCAL_GRID_MAX=8
ARM_cortex-m0-32bit := -mcpu=cortex-m0 -mthumb -DSELFCAL_FIXED=32
ARM_WARNINGS := -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wdouble-promotion -Werror
ARM_COMPILE := -O2 -std=c99 -ffp-contract=off -ffunction-sections -fdata-sections $(ARM_WARNINGS)
