"""What ``scripts/mutate.py --random`` draws, which tests it runs, and how it judges them."""
