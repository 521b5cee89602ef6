"""The arm on its serial line: protocol, port, queue model, feedback, flow control and every way to stop."""
