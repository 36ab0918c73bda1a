/* Sizes of the Python package's builds, which take any model: see lib/selfcal_tables.h. `selfcal codegen` writes such
 * a file for a model. */
#ifndef SELFCAL_CONFIG_H
#define SELFCAL_CONFIG_H

#define SELFCAL_AXES_MAX 6
#define SELFCAL_HYPOTHESES_MAX 8
#ifndef SELFCAL_GRID_MAX
#define SELFCAL_GRID_MAX 24
#endif
#define SELFCAL_ALPHA_MAX SELFCAL_GRID_MAX
#define SELFCAL_HYPOTHESIS_NODES_MAX (SELFCAL_GRID_MAX * SELFCAL_GRID_MAX)
#define SELFCAL_NODES_MAX (SELFCAL_HYPOTHESES_MAX * SELFCAL_HYPOTHESIS_NODES_MAX)
#define SELFCAL_REGRESSORS_MAX 6
#define SELFCAL_TERMS_MAX 3
#define SELFCAL_BATCH 16
#define SELFCAL_PUSH_NODES 1
#define SELFCAL_PUSH_EVERY 1
#ifndef SELFCAL_LINES
#define SELFCAL_LINES 36
#endif
#define SELFCAL_RETIRE_BLOCKS 60
#ifndef SELFCAL_REPORT_QUALITY
#define SELFCAL_REPORT_QUALITY 2
#endif

#endif
