// upb_constant_product: product = FACTOR * x for signed x, as shifts and adds: no multiplier, no clock.
//
// FACTOR is written in its canonical signed digits (-1, 0, 1, no two neighbours both set), the fewest there are; the digits
// are summed as a balanced tree. product is exact modulo 2^OUT.
module upb_constant_product #(
    parameter integer IN = 16,
    parameter integer OUT = 32,
    parameter signed [31:0] FACTOR = 1
) (
    input  wire [ IN-1:0] x,         // signed, as is product
    output wire [OUT-1:0] product
);
    // The canonical form of f has +1 at digit n where bit n + 1 is set in 3 f and not in f, -1 the other way round.
    localparam signed [34:0] WIDE = FACTOR;
    localparam signed [34:0] TRIPLE = WIDE + WIDE + WIDE;
    localparam [34:0] ADDS = TRIPLE & ~WIDE, TAKES = ~TRIPLE & WIDE;
    localparam [33:0] PLUS = ADDS[34:1], MINUS = TAKES[34:1];

    function automatic integer ones(input [33:0] bits);
        integer n;
        begin
            ones = 0;
            for (n = 0; n < 34; n = n + 1) if (bits[n]) ones = ones + 1;
        end
    endfunction

    // Place of the n-th set bit.
    function automatic integer place(input [33:0] bits, input integer n);
        integer at, left;
        begin
            place = 0;
            left = n;
            for (at = 0; at < 34; at = at + 1)
                if (bits[at]) begin
                    if (left == 0) place = at;
                    left = left - 1;
                end
        end
    endfunction

    localparam integer ADDED = ones(PLUS);
    localparam integer TAKEN = ones(MINUS);

    wire [OUT-1:0] wide = {{(OUT > IN ? OUT - IN : 1) {x[IN-1]}}, x};
    wire [OUT-1:0] plus, minus;
    generate
        if (ADDED == 0) begin : no_plus
            assign plus = {OUT{1'b0}};
        end else begin : some_plus
            wire [OUT-1:0] up_to[0:ADDED-1];
            for (genvar n = 0; n < ADDED; n = n + 1) begin : digit
                if (n == 0) assign up_to[n] = wide << place(PLUS, n);
                else assign up_to[n] = up_to[n-1] + (wide << place(PLUS, n));
            end
            assign plus = up_to[ADDED-1];
        end
        if (TAKEN == 0) begin : no_minus
            assign minus = {OUT{1'b0}};
        end else begin : some_minus
            wire [OUT-1:0] up_to[0:TAKEN-1];
            for (genvar n = 0; n < TAKEN; n = n + 1) begin : digit
                if (n == 0) assign up_to[n] = wide << place(MINUS, n);
                else assign up_to[n] = up_to[n-1] + (wide << place(MINUS, n));
            end
            assign minus = up_to[TAKEN-1];
        end
        if (TAKEN == 0) assign product = plus;
        else assign product = plus - minus;
    endgenerate
endmodule
