"""What a recording's name may end in: the readers, the help and the complaints take it from here."""

#: Text, each with .gz too.
TEXT = (".csv", ".tsv", ".txt", ".log")
#: Arrays: numpy, MATLAB, R.
ARRAYS = (".npz", ".mat", ".rda", ".rdata", ".rds")
#: All of them, as they are told to a user.
READ = f"{', '.join((*TEXT, *ARRAYS))}; .gz of text"
#: Those that are written, and how that is told.
WRITTEN = ".csv, .csv.gz or .npz"
