"""A dataset in BIDS: its layout, its cases as case folders of ours, the call of a BIDS-App."""
