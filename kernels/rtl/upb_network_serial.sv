`include "upb_check.svh"
// upb_network_serial: steps 4 to 7 of the contract (see upb_network_parallel) with 8 / PHASES multipliers, PHASES clocks a hidden unit.
//
// A unit takes eight products: W[0..5] * e, M * m and V * z. Product p is at multiplier p % MULTIPLIERS in phase p / MULTIPLIERS. z of a unit is
// ready some clocks after its own products, so that V * z of a unit takes place BEHIND units later, in the last phase, at the last
// multiplier. X holds the weights in this order, word n for clock n (V already moved by BEHIND units); the generator makes it and checks it.
//
// load: a new window is at e and m; it stays for FOLD = HIDDEN * PHASES clocks. load comes every FOLD clocks.
// Latency: total is there at load + LATENCY, until the next window's: FOLD + BEHIND * PHASES + 3.
module upb_network_serial #(
    parameter integer XBITS = 16,
    parameter integer WBITS = 8,       // of W and V
    parameter integer HIDDEN = 12,
    parameter integer PHASES = 2,
    parameter integer BEHIND = 3,
    parameter integer K = 0,
    parameter integer J = 0,
    parameter integer SLOPE = 0,
    parameter integer RECTIFY = 1,
    parameter [31:0] C = 32'd0,
    parameter [HIDDEN*8*16-1:0] X = 0,
    parameter [HIDDEN*32-1:0] B = 0,
    parameter integer WRITABLE = 0   // weights can be written; see upb_memory
) (
    input  wire               clk,
    input  wire               rst,
    input  wire               load,
    input  wire               bank,    // WRITABLE: of the weights, with load
    input  wire [       44:0] port,
    input  wire [6*XBITS-1:0] e,
    input  wire [  XBITS-1:0] m,
    output reg  [       31:0] total
);
    localparam integer WORD = 16;  // of a weight in X: M needs it
    localparam integer MULTIPLIERS = 8 / PHASES;
    localparam integer FOLD = HIDDEN * PHASES;
    localparam integer BITS = $clog2(FOLD);
    localparam integer PHASE_BITS = $clog2(PHASES);
    localparam integer M_PHASE = 6 / MULTIPLIERS, M_AT = 6 % MULTIPLIERS;
    localparam integer V_PHASE = PHASES - 1, V_AT = MULTIPLIERS - 1;
    localparam integer PB = 16 + WORD;

    `UPB_REQUIRE(PHASES == 2 || PHASES == 4 || PHASES == 8, bad_phases,
                 "upb_network_serial: PHASES must be 2, 4 or 8")
    `UPB_REQUIRE(BEHIND * PHASES >= RECTIFY + 5 && BEHIND * PHASES < RECTIFY + 5 + PHASES, bad_behind,
                 "upb_network_serial: BEHIND does not meet the clock at which z is ready")
    `UPB_REQUIRE(WRITABLE == 0 || BEHIND <= HIDDEN, bad_writable,
                 "upb_network_serial: WRITABLE needs as many hidden units as a unit's V is behind")

    // ------------------------------------------------------------------ which bank, and C
    // V of a window is read beside W of the next one, of the same word: banks change after a window that counts for nothing (beam 0
    // has none), so that no V is read of the wrong bank.
    wire now_bank, b_bank, c_bank;
    wire [31:0] c_now;
    generate
        if (WRITABLE == 0) begin : one_bank
            assign {now_bank, b_bank, c_bank} = 3'b000;
            assign c_now = C;
        end else begin : two_banks
            reg kept_bank;
            reg [31:0] c0 = C, c1 = C;
            always @(posedge clk) begin
                kept_bank <= now_bank;
                if (port[43] && port[42:40] == 3'd4)
                    if (port[44]) c1 <= port[31:0];
                    else c0 <= port[31:0];
            end
            assign now_bank = load ? bank : kept_bank;
            upb_shift #(.WIDTH(1), .DEPTH(2)) to_b (.clk(clk), .d(now_bank), .q(b_bank));
            upb_shift #(.WIDTH(1), .DEPTH(3)) to_c (.clk(clk), .d(now_bank), .q(c_bank));
            assign c_now = c_bank ? c1 : c0;
        end
    endgenerate

    // ------------------------------------------------------------------ clock 0: which step
    reg [BITS-1:0] step;
    wire [BITS-1:0] at = load ? {BITS{1'b0}} : step;
    always @(posedge clk)
        if (rst) step <= {BITS{1'b0}};
        else step <= at == FOLD - 1 ? {BITS{1'b0}} : at + 1'b1;

    // The phase, and whether this is unit 0 (and the unit whose V slot is unit 0's), travel along.
    wire [PHASE_BITS-1:0] phase0 = at[PHASE_BITS-1:0];
    wire zero0 = (at >> PHASE_BITS) == BEHIND % HIDDEN;
    wire [PHASE_BITS-1:0] phase1, phase2, phase3, phase4, phase5, phase6;
    wire zero3;
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase1 (.clk(clk), .d(phase0), .q(phase1));
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase2 (.clk(clk), .d(phase1), .q(phase2));
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase3 (.clk(clk), .d(phase2), .q(phase3));
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase4 (.clk(clk), .d(phase3), .q(phase4));
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase5 (.clk(clk), .d(phase4), .q(phase5));
    upb_shift #(.WIDTH(PHASE_BITS), .DEPTH(1)) to_phase6 (.clk(clk), .d(phase5), .q(phase6));
    upb_shift #(.WIDTH(1), .DEPTH(3)) to_zero3 (.clk(clk), .d(zero0), .q(zero3));

    // ------------------------------------------------------------------ clock 1: weights
    wire [MULTIPLIERS*WORD-1:0] word1;
    upb_memory #(
        .WIDTH(MULTIPLIERS * WORD), .DEPTH(FOLD), .ADDRESS(BITS), .INIT(X),
        .WRITABLE(WRITABLE), .SELECT(3'd0)
    ) rom (
        .clk(clk), .bank(now_bank), .port(port), .address(at), .q(word1)
    );
    reg [6*XBITS-1:0] e1;
    reg [XBITS-1:0] m1;
    always @(posedge clk) begin
        e1 <= e;
        m1 <= m;
    end

    function automatic signed [15:0] operand(input [XBITS-1:0] x);
        if (XBITS == 16) operand = {~x[XBITS-1], x[XBITS-2:0]};
        else operand = {{(16 - XBITS) {1'b0}}, x};
    endfunction

    // ------------------------------------------------------------------ clocks 2 and 3: operands, products
    wire [15:0] z;
    wire [MULTIPLIERS*PB-1:0] product3;
    generate
        for (genvar j = 0; j < MULTIPLIERS; j = j + 1) begin : multiplier
            wire [PHASES*16-1:0] choices;
            for (genvar n = 0; n < PHASES; n = n + 1) begin : choice
                if (n * MULTIPLIERS + j < 6) assign choices[n*16 +: 16] = operand(e1[(n*MULTIPLIERS+j)*XBITS +: XBITS]);
                else if (n * MULTIPLIERS + j == 6) assign choices[n*16 +: 16] = operand(m1);
                else assign choices[n*16 +: 16] = z;
            end
            reg signed [15:0] x2;
            reg signed [WORD-1:0] w2;
            reg signed [PB-1:0] p3;
            always @(posedge clk) begin
                x2 <= $signed(choices[phase1*16 +: 16]);
                w2 <= $signed(word1[j*WORD +: WORD]);
                p3 <= x2 * w2;
            end
            assign product3[j*PB +: PB] = p3;
        end
    endgenerate

    // ------------------------------------------------------------------ clocks 4 and 5: the sum of W * e
    localparam integer EXACT = 16 + WBITS + 3;  // bits that hold six products
    localparam integer SUM = EXACT < 32 ? EXACT : 32;
    reg signed [SUM-1:0] part4, sum5;
    wire signed [4*SUM-1:0] counted;  // those of W, as a tree of four
    generate
        for (genvar n = 0; n < 4; n = n + 1) begin : of_w
            if (n < MULTIPLIERS) begin : there
                wire signed [SUM-1:0] wide = $signed(product3[n*PB +: PB]);
                assign counted[n*SUM +: SUM] = phase3 * MULTIPLIERS + n < 6 ? wide : {SUM{1'b0}};
            end else begin : not_there
                assign counted[n*SUM +: SUM] = {SUM{1'b0}};
            end
        end
    endgenerate
    wire [SUM-1:0] part = (counted[0 +: SUM] + counted[SUM +: SUM]) + (counted[2*SUM +: SUM] + counted[3*SUM +: SUM]);

    wire [31:0] b3;
    wire [BITS-1:0] at2;
    upb_shift #(.WIDTH(BITS), .DEPTH(2)) to_unit (.clk(clk), .d(at), .q(at2));
    upb_memory #(
        .WIDTH(32), .DEPTH(HIDDEN), .ADDRESS(BITS), .INIT(B),
        .WRITABLE(WRITABLE), .SELECT(3'd2)
    ) biases (
        .clk(clk), .bank(b_bank), .port(port), .address(at2 >> PHASE_BITS), .q(b3)
    );

    wire signed [31:0] m_product = $signed(product3[M_AT*PB +: PB]);
    wire signed [31:0] v_product = $signed(product3[V_AT*PB +: PB]);
    wire signed [31:0] w_sum = sum5;
    reg [31:0] mb, S;
    always @(posedge clk) begin
        part4 <= part;
        sum5 <= (phase4 == 0 ? {SUM{1'b0}} : sum5) + part4;
        if (phase3 == M_PHASE) mb <= (m_product <<< J) + b3;
        if (phase5 == PHASES - 1) S <= (w_sum <<< K) + mb;
        if (phase3 == V_PHASE) total <= (zero3 ? c_now : total) + v_product;
    end

    upb_rectifier #(.SLOPE(SLOPE), .LATENCY(RECTIFY)) rectifier (
        .clk(clk), .enable(phase6 == PHASES - 1), .a(S[31:16]), .z(z)
    );
endmodule
