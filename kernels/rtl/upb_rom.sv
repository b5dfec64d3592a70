// upb_rom: q(t + 1) = INIT[address(t)], DEPTH words of WIDTH bits, word 0 lowest.
module upb_rom #(
    parameter integer WIDTH = 8,
    parameter integer DEPTH = 1,
    parameter integer ADDRESS = 1,
    parameter [WIDTH*DEPTH-1:0] INIT = {(WIDTH * DEPTH) {1'b0}}
) (
    input  wire               clk,
    input  wire [ADDRESS-1:0] address,
    output reg  [  WIDTH-1:0] q
);
    reg [WIDTH-1:0] memory[0:DEPTH-1];
    integer n;
    initial for (n = 0; n < DEPTH; n = n + 1) memory[n] = INIT[n*WIDTH +: WIDTH];
    always @(posedge clk) q <= memory[address];
endmodule
