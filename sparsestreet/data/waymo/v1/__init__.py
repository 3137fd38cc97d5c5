"""Version 1: a segment is one file of records (TFRecord), a record the message of one frame (protobuf)."""
