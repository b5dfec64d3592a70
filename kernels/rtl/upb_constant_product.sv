// upb_constant_product: product = FACTOR * x for signed x, as shifts and adds: no multiplier, no clock.
//
// FACTOR (at most 17 bits) is written in its canonical signed digits (-1, 0, 1, no two neighbours both set), the fewest
// there are, at most 8; those of each sign are summed as a tree. product is exact modulo 2^OUT.
module upb_constant_product #(
    parameter integer IN = 16,
    parameter integer OUT = 32,
    parameter signed [31:0] FACTOR = 1
) (
    input  wire [ IN-1:0] x,         // signed, as is product
    output wire [OUT-1:0] added,     // of the digits 1
    output wire [OUT-1:0] taken,     // of the digits -1
    output wire [OUT-1:0] product    // added - taken
);
    // The canonical form of f has +1 at digit n where bit n + 1 is set in 3 f and not in f, -1 the other way round.
    localparam signed [34:0] WIDE = FACTOR;
    localparam signed [34:0] TRIPLE = WIDE + WIDE + WIDE;
    localparam [34:0] ADDS = TRIPLE & ~WIDE, TAKES = ~TRIPLE & WIDE;
    localparam [33:0] PLUS = ADDS[34:1], MINUS = TAKES[34:1];

    // Place of the n-th set bit, or -1.
    function automatic integer place(input [33:0] bits, input integer n);
        integer at, left;
        begin
            place = -1;
            left = n;
            for (at = 0; at < 34; at = at + 1)
                if (bits[at]) begin
                    if (left == 0) place = at;
                    left = left - 1;
                end
        end
    endfunction

    wire [OUT-1:0] wide = {{(OUT > IN ? OUT - IN : 1) {x[IN-1]}}, x};
    wire [8*OUT-1:0] plus, minus;
    generate
        for (genvar n = 0; n < 8; n = n + 1) begin : digit
            localparam integer ADDED = place(PLUS, n), TAKEN = place(MINUS, n);
            if (ADDED >= 0) begin : adds
                assign plus[n*OUT +: OUT] = wide << ADDED;
            end else begin : adds_not
                assign plus[n*OUT +: OUT] = {OUT{1'b0}};
            end
            if (TAKEN >= 0) begin : takes
                assign minus[n*OUT +: OUT] = wide << TAKEN;
            end else begin : takes_not
                assign minus[n*OUT +: OUT] = {OUT{1'b0}};
            end
        end
    endgenerate

    function automatic [OUT-1:0] tree(input [8*OUT-1:0] t);
        tree = ((t[0 +: OUT] + t[OUT +: OUT]) + (t[2*OUT +: OUT] + t[3*OUT +: OUT]))
             + ((t[4*OUT +: OUT] + t[5*OUT +: OUT]) + (t[6*OUT +: OUT] + t[7*OUT +: OUT]));
    endfunction
    assign added = tree(plus);
    assign taken = tree(minus);
    assign product = added - taken;
endmodule
