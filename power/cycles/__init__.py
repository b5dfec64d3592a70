"""How long the work takes: models of CPUs, GPUs and the FPGA core, each with an interval and what it rests on."""
