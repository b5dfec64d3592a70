// upb_sum: registered binary tree: total(t + ceil(log2 N)) = sum of N signed terms of WIDTH bits, modulo 2^WIDTH.
module upb_sum #(
    parameter integer N = 2,
    parameter integer WIDTH = 32
) (
    input  wire               clk,
    input  wire [N*WIDTH-1:0] terms,
    output wire [  WIDTH-1:0] total
);
    localparam integer HALF = (N + 1) / 2;
    generate
        if (N == 1) begin : one
            assign total = terms;
        end else begin : tree
            reg [HALF*WIDTH-1:0] pairs;
            for (genvar n = 0; n < HALF; n = n + 1) begin : pair
                if (2 * n + 1 < N) begin : two
                    always @(posedge clk)
                        pairs[n*WIDTH +: WIDTH] <= terms[2*n*WIDTH +: WIDTH] + terms[(2*n+1)*WIDTH +: WIDTH];
                end else begin : odd
                    always @(posedge clk) pairs[n*WIDTH +: WIDTH] <= terms[2*n*WIDTH +: WIDTH];
                end
            end
            upb_sum #(.N(HALF), .WIDTH(WIDTH)) rest (.clk(clk), .terms(pairs), .total(total));
        end
    endgenerate
endmodule
