"""Speed, measured in one run: medians and ratios, because absolute times drift on a shared machine."""
