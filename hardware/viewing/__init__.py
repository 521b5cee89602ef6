"""`stillbed view`: a recorded session in a browser, with a slider over its time; reads, and writes nothing."""
