# Rscript tsoutliers.R DIR: for each DIR/*.csv with a column y one line file,AO,LS,TC: how many of each Chen-Liu finds.
# Exit code 77: the package is not installed. rivals.py writes the files and reads the lines.
if (!requireNamespace("tsoutliers", quietly = TRUE)) quit(status = 77)
types <- c("AO", "LS", "TC")
for (file in sort(list.files(commandArgs(trailingOnly = TRUE)[1], pattern = "[.]csv$", full.names = TRUE))) {
  y <- ts(read.csv(file)$y)
  found <- try(suppressWarnings(tsoutliers::tso(y / sd(y), types = types)), silent = TRUE)
  kinds <- if (inherits(found, "try-error")) character(0) else as.character(found$outliers$type)
  cat(basename(file), sapply(types, function(type) sum(kinds == type)), sep = ",")
  cat("\n")
}
