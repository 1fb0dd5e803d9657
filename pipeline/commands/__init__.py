"""What the commands do; ``cli.py`` only takes their words apart, prints and exits."""
