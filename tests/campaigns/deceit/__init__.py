"""Sessions made to fool the tracker: a world renderer of its own, exact truth, and a judge of silently wrong poses.

python -m tests.campaigns.deceit --count 200 --seed 1 --jobs 2 -o out/deceit
python -m tests.campaigns.deceit --kind board_jump -o out/board --sheets
"""
