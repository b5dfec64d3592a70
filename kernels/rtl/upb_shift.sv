// upb_shift: q(t) = d(t - DEPTH). DEPTH = 0 is a wire. No reset: for data, and for strobes whose first clocks are unread.
module upb_shift #(
    parameter integer WIDTH = 1,
    parameter integer DEPTH = 1
) (
    input  wire             clk,
    input  wire [WIDTH-1:0] d,
    output wire [WIDTH-1:0] q
);
    wire [(DEPTH+1)*WIDTH-1:0] tap;
    assign tap[0 +: WIDTH] = d;
    assign q = tap[DEPTH*WIDTH +: WIDTH];
    generate
        for (genvar n = 0; n < DEPTH; n = n + 1) begin : stage
            reg [WIDTH-1:0] held;
            always @(posedge clk) held <= tap[n*WIDTH +: WIDTH];
            assign tap[(n+1)*WIDTH +: WIDTH] = held;
        end
    endgenerate
endmodule
