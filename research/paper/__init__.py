"""The paper's Evaluation, measured again: claims, instruments and verdicts."""
