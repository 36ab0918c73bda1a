"""The whole calibration from rests in several positions: scale, misalignment, bias, g-sensitivity."""
