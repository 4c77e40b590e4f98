"""The network of the paper: EdgeConv encoders, VelocityModule, DistanceModule, StraightPCF."""
