// upb_strobes: tap[n](t) = d(t - n) for n = 0..DEPTH. Cleared by reset: times the free-running pipeline.
module upb_strobes #(
    parameter integer DEPTH = 1
) (
    input  wire           clk,
    input  wire           rst,
    input  wire           d,
    output wire [DEPTH:0] tap
);
    reg [DEPTH-1:0] line;
    always @(posedge clk)
        if (rst) line <= {DEPTH{1'b0}};
        else line <= tap[DEPTH-1:0];
    assign tap = {line, d};
endmodule
