"""MCAP in and out: the recorder, its messages and schemas, and recordings read back as sessions."""
