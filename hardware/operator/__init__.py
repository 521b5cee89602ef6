"""The operator's page: what the run shows, what the operator asks, and the process that serves both to browsers.

The run puts `OperatorView`, `Scene` and `Pictures` into shared memory and takes `Request`s out of it; it never waits
for the page, and the page cannot reach it in any other way. Whatever happens to the page, its process or its windows,
the run goes on as if nobody had looked.
"""
