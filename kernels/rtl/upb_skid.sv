// upb_skid: register slice of a valid/ready stream. Full rate; both directions are registered.
// Latency 1 clock. in_ready depends on registers alone, so that no path leads from out_ready to in_ready.
module upb_skid #(
    parameter integer WIDTH = 8
) (
    input  wire             clk,
    input  wire             rst,
    input  wire             in_valid,
    output wire             in_ready,
    input  wire [WIDTH-1:0] in_data,
    output wire             out_valid,
    input  wire             out_ready,
    output wire [WIDTH-1:0] out_data
);
    reg             full;   // head holds a beat
    reg             extra;  // spare holds the beat that came while the head was blocked
    reg [WIDTH-1:0] head;
    reg [WIDTH-1:0] spare;

    // Not ready during reset, as AXI4-Stream asks of a source's partner that has no state yet.
    reg awake;
    assign in_ready = awake && !extra;
    assign out_valid = full;
    assign out_data = head;
    wire accepted = in_valid && in_ready;
    wire free = !full || out_ready;

    always @(posedge clk) begin
        if (free) head <= extra ? spare : in_data;
        if (!extra) spare <= in_data;
        if (rst) begin
            awake <= 1'b0;
            full <= 1'b0;
            extra <= 1'b0;
        end else begin
            awake <= 1'b1;
            if (free) full <= extra || accepted;
            extra <= !free && (extra || accepted);
        end
    end
`ifdef FORMAL
    // Any one beat is followed through (numbers modulo 16): what went in comes out, in order, once.
    (* anyconst *) reg [3:0] watched;
    reg [3:0] taken, given;
    reg [WIDTH-1:0] kept;
    reg past;
    initial {past, taken, given} = 0;
    wire [3:0] place = watched - given;
    wire inside = place < (taken - given);
    always @(posedge clk) begin
        past <= 1'b1;
        if (rst) {taken, given} <= 0;
        else begin
            taken <= taken + accepted;
            given <= given + (out_valid && out_ready);
        end
        if (accepted && taken == watched) kept <= in_data;
        assume (past || rst);
        if (past) begin
            counted: assert (taken - given == {3'd0, full} + {3'd0, extra});
            spare_behind_head: assert (!extra || full);
            if (inside) in_order: assert ((place == 4'd0 ? head : spare) == kept);
            if (!rst && $past(!rst && out_valid && !out_ready)) begin
                valid_holds: assert (out_valid);
                data_holds: assert ($stable(out_data));
            end
            if ($past(rst)) reset_quiet: assert (!in_ready && !out_valid);
            if (!rst && $past(awake && !extra && !rst) && $past(!in_valid)) ready_holds: assert (in_ready);
        end
    end
`endif
endmodule
