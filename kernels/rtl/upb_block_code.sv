// upb_block_code: step 3 of the contract: eight bits of each difference, at one power of two for the six of a window.
//
//   s = max(0, bits(max(d)) - 8);  q[i] = min(255, round_shift(d[i], s));  e[i] = q[i] << s
//
// Given is e, so that what follows needs no shift by s: sum(W * q) << s = sum(W * e). bits(max(d)) is the length of the OR
// of all d. No shifter: e is d with half a step added and the s low bits cleared.
// Latency: 3 clocks (ENABLE = 0, int16: e = d, 0).
module upb_block_code #(
    parameter integer ENABLE = 1
) (
    input  wire        clk,
    input  wire [95:0] d,
    output wire [95:0] e
);
    generate
        if (ENABLE == 0) begin : none
            assign e = d;
        end else begin : code
            // Stage 1: reach[p] = some d has bit p or a higher one. Bit b < s of a code is dropped: reach[b + 8].
            reg [16:0] reach;
            reg [95:0] d1;
            wire [15:0] any = d[15:0] | d[31:16] | d[47:32] | d[63:48] | d[79:64] | d[95:80];
            integer p;
            always @(posedge clk) begin
                for (p = 0; p < 16; p = p + 1) reach[p] <= |(any >> p);
                reach[16] <= 1'b0;
                d1 <= d;
            end
            wire [ 8:0] dropped1 = reach[16:8];
            wire [15:0] half = {8'd0, dropped1[7:0] & ~dropped1[8:1]};  // 2^(s - 1), or 0

            // Stage 2: d + half a step. Stage 3: low bits cleared; 256 becomes 255.
            reg [16:0] reach2;
            always @(posedge clk) reach2 <= reach;
            for (genvar i = 0; i < 6; i = i + 1) begin : each
                reg [16:0] sum;
                reg [15:0] coded;
                wire over = |(sum[16:9] & ~reach2[16:9]);  // a carry past the highest bit of the window
                always @(posedge clk) begin
                    sum <= d1[16*i +: 16] + half;
                    coded <= (over ? reach2[15:0] : sum[15:0]) & {8'hff, ~reach2[15:8]};
                end
                assign e[16*i +: 16] = coded;
            end
        end
    endgenerate
endmodule
