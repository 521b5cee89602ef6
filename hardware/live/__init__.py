"""The live run: processes, stages, stopping, recording and resuming of a print before real or pre-rendered cameras."""
