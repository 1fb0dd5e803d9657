"""Bytes to dataclasses and back; no stage is known here."""
