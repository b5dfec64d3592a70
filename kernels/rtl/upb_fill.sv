// upb_fill: the empty-pixel rule `fill` (docs/model-format.md) for values of WIDTH bits; order of the six as everywhere.
//
//   top[c] = seen(r0, c) ? x(r0, c) : x(r1, c);  bottom[c] the other way round;  has[c] = seen(r0, c) or seen(r1, c)
//   left  <- left, else middle, else right;  right <- right, else middle, else left
//   middle <- middle, else min(left, right), else the one there is: top and bottom apart
//
// What is not seen is 0, so that a window without a return is 0. Distances and intensities are filled in the same places:
// `seen` is the distances'. Latency: 3 clocks (ENABLE = 0, rule `none`: 0).
module upb_fill #(
    parameter integer WIDTH  = 16,
    parameter integer ENABLE = 1
) (
    input  wire               clk,
    input  wire [        5:0] seen,
    input  wire [6*WIDTH-1:0] x,
    output wire [6*WIDTH-1:0] filled
);
    generate
        if (ENABLE == 0) begin : none
            assign filled = x;
        end else begin : fill
            reg [6*WIDTH-1:0] across;      // stage 1: from the opposite row
            reg [2:0] has;
            reg [6*WIDTH-1:0] across_held; // stage 2: which neighbour is less
            reg [2:0] has_held;
            reg [1:0] left_less;
            reg [6*WIDTH-1:0] result;      // stage 3: from the nearest column
            assign filled = result;

            for (genvar c = 0; c < 3; c = c + 1) begin : column
                wire [WIDTH-1:0] top = x[c*WIDTH +: WIDTH];
                wire [WIDTH-1:0] bottom = x[(c+3)*WIDTH +: WIDTH];
                always @(posedge clk) begin
                    has[c] <= seen[c] || seen[c+3];
                    across[c*WIDTH +: WIDTH] <= seen[c] ? top : bottom;
                    across[(c+3)*WIDTH +: WIDTH] <= seen[c+3] ? bottom : top;
                end
            end

            always @(posedge clk) begin
                across_held <= across;
                has_held <= has;
            end

            for (genvar r = 0; r < 2; r = r + 1) begin : row
                wire [WIDTH-1:0] left = across_held[(3*r)*WIDTH +: WIDTH];
                wire [WIDTH-1:0] middle = across_held[(3*r+1)*WIDTH +: WIDTH];
                wire [WIDTH-1:0] right = across_held[(3*r+2)*WIDTH +: WIDTH];
                wire use_left = has_held[0] && (left_less[r] || !has_held[2]);
                always @(posedge clk) begin
                    left_less[r] <= across[(3*r)*WIDTH +: WIDTH] < across[(3*r+2)*WIDTH +: WIDTH];
                    result[(3*r)*WIDTH +: WIDTH] <= has_held[0] ? left : has_held[1] ? middle : right;
                    result[(3*r+1)*WIDTH +: WIDTH] <= has_held[1] ? middle : use_left ? left : right;
                    result[(3*r+2)*WIDTH +: WIDTH] <= has_held[2] ? right : has_held[1] ? middle : left;
                end
            end
        end
    endgenerate
endmodule
