"""The filter and its network: tensors in, tensors out; torch, numpy and scipy only."""
