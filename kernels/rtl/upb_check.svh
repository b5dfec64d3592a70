// `UPB_REQUIRE(condition, label, message): stops elaboration with the message unless the condition holds.
// Yosys prints the message of $error only; for Verilator $error is a warning; Icarus has no elaboration tasks: there the
// simulation stops before its first clock.
`ifndef UPB_CHECK
`define UPB_CHECK
`ifdef __ICARUS__
`define UPB_STOP(message) initial $fatal(1, message);
`elsif YOSYS
`define UPB_STOP(message) $error(message);
`else
`define UPB_STOP(message) $fatal(1, message);
`endif
`define UPB_REQUIRE(condition, label, message) \
    generate if (!(condition)) begin : label `UPB_STOP(message) end endgenerate
`endif
