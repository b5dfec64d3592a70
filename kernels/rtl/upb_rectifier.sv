`include "upb_check.svh"
// upb_rectifier: step 6: z = max(a, round_shift(a * SLOPE, 15)): a where a >= 0, else the product (SLOPE < 32768).
// SLOPE = 0: z = max(a, 0). Latency: LATENCY clocks, 2 unless SLOPE = 0.
module upb_rectifier #(
    parameter integer SLOPE = 0,
    parameter integer LATENCY = 1
) (
    input  wire        clk,
    input  wire        enable,   // z changes LATENCY clocks after
    input  wire [15:0] a,
    output reg  [15:0] z
);
    `UPB_REQUIRE(LATENCY == 2 || (LATENCY == 1 && SLOPE == 0), bad_latency,
                 "upb_rectifier: LATENCY must be 2, or 1 where SLOPE is 0")

    generate
        if (LATENCY == 1) begin : plain
            always @(posedge clk) if (enable) z <= a[15] ? 16'd0 : a;
        end else begin : leaky
            wire [31:0] product;
            reg  [31:0] leaked;
            reg  [15:0] a1;
            reg         enable1;
            upb_constant_product #(.IN(16), .OUT(32), .FACTOR(SLOPE)) slope (
                .x(a), .added(), .taken(), .product(product)
            );
            wire [31:0] rounded = leaked + 32'd16384;
            always @(posedge clk) begin
                leaked <= product;
                a1 <= a;
                enable1 <= enable;
                if (enable1) z <= a1[15] ? rounded[30:15] : a1;
            end
        end
    endgenerate
endmodule
