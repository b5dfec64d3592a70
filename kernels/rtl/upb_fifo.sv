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
`ifdef FORMAL
    // The writer of the protocol: it begins a beat only while `room` is high; the beat is written at most TRAVEL clocks later.
    localparam integer TRAVEL = SLACK - 2;
    (* anyseq *) reg begins;
    reg [TRAVEL-1:0] travelling;
    reg [BITS:0] underway;
    integer n;
    always @* begin
        underway = 0;
        for (n = 0; n < TRAVEL; n = n + 1) underway = underway + travelling[n];
    end

    // Any one entry is followed through, as in upb_skid.
    (* anyconst *) reg [BITS:0] watched;
    reg [WIDTH-1:0] kept;
    reg past;
    initial past = 0;
    wire inside = (watched - taken) < level;
    wire [BITS:0] at_output = taken - 1'b1;
    always @(posedge clk) begin
        past <= 1'b1;
        travelling <= rst ? {TRAVEL{1'b0}} : {travelling, begins && room};
        if (push && written == watched) kept <= in_data;
        assume (past || rst);
        assume (write == travelling[TRAVEL-1]);
        if (past) begin
            within: assert (level <= DEPTH);
            room_is_true: assert (!room || level <= DEPTH - SLACK + 1);
            enough_room: assert (level + underway <= DEPTH);
            no_overrun: assert (!overrun);
            if (inside) in_order: assert (memory[watched[BITS-1:0]] == kept);
            if (out_valid && watched == at_output && $past(inside || out_valid)) out_in_order: assert (out_data == kept);
            if (!rst && $past(!rst && out_valid && !out_ready)) begin
                valid_holds: assert (out_valid);
                data_holds: assert ($stable(out_data));
            end
            if (!rst && $past(!rst && empty && (!out_valid || out_ready))) no_underflow: assert (!out_valid);
        end
    end
`endif
endmodule
