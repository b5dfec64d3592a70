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
endmodule
