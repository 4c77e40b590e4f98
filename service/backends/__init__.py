"""Where clouds are computed: the protocol (`base`) and one process per device on this machine (`local`)."""
