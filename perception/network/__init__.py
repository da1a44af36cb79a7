"""The torch detector: lift, encoder, fusion, head, weights, and how it is flown."""
