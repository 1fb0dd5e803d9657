"""Which label is which structure: names, presets, labels that a case or a program brought, whether they fit the CT."""
