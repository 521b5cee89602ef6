"""MCAP in and out: the recorder, its messages and schemas, and recordings read back as sessions."""

__all__ = ["mcap_file", "mcap_writer", "messages", "recorder", "ros_messages", "session_reader"]
