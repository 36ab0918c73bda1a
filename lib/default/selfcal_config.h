/* Made by `selfcal codegen` from the model 'default' for cortex-m4f. Do not edit.
 * The compiler's command line may set any of these. lib/selfcal_tables.h explains each. */
#ifndef SELFCAL_CONFIG_H
#define SELFCAL_CONFIG_H

#ifndef SELFCAL_AXES_MAX
#define SELFCAL_AXES_MAX 6
#endif
#ifndef SELFCAL_HYPOTHESES_MAX
#define SELFCAL_HYPOTHESES_MAX 3
#endif
#ifndef SELFCAL_GRID_MAX
#define SELFCAL_GRID_MAX 16
#endif
#ifndef SELFCAL_ALPHA_MAX
#define SELFCAL_ALPHA_MAX 12
#endif
#ifndef SELFCAL_HYPOTHESIS_NODES_MAX
#define SELFCAL_HYPOTHESIS_NODES_MAX 192
#endif
#ifndef SELFCAL_NODES_MAX
#define SELFCAL_NODES_MAX 209
#endif
#ifndef SELFCAL_REGRESSORS_MAX
#define SELFCAL_REGRESSORS_MAX 1
#endif
#ifndef SELFCAL_TERMS_MAX
#define SELFCAL_TERMS_MAX 1
#endif
#ifndef SELFCAL_BATCH
#define SELFCAL_BATCH 16
#endif
#ifndef SELFCAL_PUSH_NODES
#define SELFCAL_PUSH_NODES 1
#endif
#ifndef SELFCAL_RETIRE_BLOCKS
#define SELFCAL_RETIRE_BLOCKS 60
#endif
#ifndef SELFCAL_REPORT_QUALITY
#define SELFCAL_REPORT_QUALITY 1
#endif
#ifndef SELFCAL_LINES
#define SELFCAL_LINES 32
#endif
#ifndef SELFCAL_PUSH_EVERY
#define SELFCAL_PUSH_EVERY 1
#endif

#endif
