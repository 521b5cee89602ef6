"""Sessions made to fool the tracker: a world renderer of its own, exact truth, and a judge of silently wrong poses."""
