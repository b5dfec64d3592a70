// upb_minimum: steps 1 and 2 of the contract for six values of WIDTH bits.
//
//   m = min(x[0..5]);  d[i] = x[i] - m
//
// Latency: 3 clocks.
module upb_minimum #(
    parameter integer WIDTH = 16
) (
    input  wire               clk,
    input  wire [6*WIDTH-1:0] x,
    output reg  [  WIDTH-1:0] m,
    output reg  [6*WIDTH-1:0] d
);
    reg [6*WIDTH-1:0] x1, x2;
    reg [3*WIDTH-1:0] pair;
    reg [  WIDTH-1:0] least;

    wire [WIDTH-1:0] a = pair[0 +: WIDTH];
    wire [WIDTH-1:0] b = pair[WIDTH +: WIDTH];
    wire [WIDTH-1:0] c = pair[2*WIDTH +: WIDTH];
    wire a_b = a < b, b_c = b < c, a_c = a < c;

    always @(posedge clk) begin
        x1 <= x;
        x2 <= x1;
        least <= a_b ? (a_c ? a : c) : (b_c ? b : c);
        m <= least;
    end

    generate
        for (genvar n = 0; n < 3; n = n + 1) begin : lesser
            wire [WIDTH-1:0] up = x[n*WIDTH +: WIDTH];
            wire [WIDTH-1:0] down = x[(n+3)*WIDTH +: WIDTH];
            always @(posedge clk) pair[n*WIDTH +: WIDTH] <= up < down ? up : down;
        end
        for (genvar n = 0; n < 6; n = n + 1) begin : difference
            always @(posedge clk) d[n*WIDTH +: WIDTH] <= x2[n*WIDTH +: WIDTH] - least;
        end
    endgenerate
endmodule
