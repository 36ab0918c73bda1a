"""The figures of Stepanov & Motorin (IFAC-PapersOnLine 50-1, 2017, 2830-2835), made anew: `selfcal paper`."""
