// upb_ring: carries a word from one place of the free-running pipeline to a later one, past the network.
// `put` and `get` are the same strobe at two fixed places; between them lie at most DEPTH - 1 (a power of two, less one) words.
// Latency: q is the word at the clock after `get`, and stays until the next.
module upb_ring #(
    parameter integer WIDTH = 8,
    parameter integer DEPTH = 16
) (
    input  wire             clk,
    input  wire             rst,
    input  wire             put,
    input  wire [WIDTH-1:0] d,
    input  wire             get,
    output reg  [WIDTH-1:0] q
);
    localparam integer BITS = $clog2(DEPTH);
    reg [WIDTH-1:0] memory[0:DEPTH-1];
    reg [BITS-1:0] into;
    reg [BITS-1:0] from;

    always @(posedge clk) begin
        if (put) memory[into] <= d;
        if (get) q <= memory[from];
        if (rst) begin
            into <= {BITS{1'b0}};
            from <= {BITS{1'b0}};
        end else begin
            if (put) into <= into + 1'b1;
            if (get) from <= from + 1'b1;
        end
    end
endmodule
