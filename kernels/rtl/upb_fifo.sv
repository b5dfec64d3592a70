`include "upb_check.svh"
// upb_fifo: synchronous FIFO of DEPTH (a power of two) entries and a registered output (valid/ready).
// The writer never waits: it keeps SLACK entries free by looking at `room`, which is registered and is high while at most
// DEPTH - SLACK entries are taken (or on their way). `overrun` is a pulse that a writer who counts right never sees; the entry is then lost.
// Latency: written at clock t, out_valid at t + 2 if empty.
module upb_fifo #(
    parameter integer WIDTH = 8,
    parameter integer DEPTH = 64,
    parameter integer SLACK = 32
) (
    input  wire             clk,
    input  wire             rst,
    input  wire             write,
    input  wire [WIDTH-1:0] in_data,
    output reg              room,
    output reg              overrun,
    output reg              out_valid,
    input  wire             out_ready,
    output reg  [WIDTH-1:0] out_data
);
    localparam integer BITS = $clog2(DEPTH);

    `UPB_REQUIRE(DEPTH >= 2 && (DEPTH & (DEPTH - 1)) == 0, bad_depth, "upb_fifo: DEPTH must be a power of two")
    `UPB_REQUIRE(SLACK < DEPTH, bad_slack, "upb_fifo: SLACK must be less than DEPTH")

    reg [WIDTH-1:0] memory[0:DEPTH-1];
    reg [BITS:0] written;
    reg [BITS:0] taken;
    wire [BITS:0] level = written - taken;
    wire full = level[BITS];
    wire empty = level == {(BITS + 1) {1'b0}};
    wire push = write && !full;
    wire pop = !empty && (!out_valid || out_ready);

    always @(posedge clk) begin
        if (push) memory[written[BITS-1:0]] <= in_data;
        if (pop) out_data <= memory[taken[BITS-1:0]];
        if (rst) begin
            written <= {(BITS + 1) {1'b0}};
            taken <= {(BITS + 1) {1'b0}};
            out_valid <= 1'b0;
            overrun <= 1'b0;
            room <= 1'b0;
        end else begin
            if (push) written <= written + 1'b1;
            if (pop) taken <= taken + 1'b1;
            if (pop) out_valid <= 1'b1;
            else if (out_ready) out_valid <= 1'b0;
            overrun <= write && full;
            room <= level <= DEPTH - SLACK;
        end
    end
endmodule
