// upb_network_parallel: steps 4 to 7 of the contract, UNITS whole hidden units a clock, FOLD clocks a window.
//
//   S[h] = ((sum over i of W[h][i] * e[i]) << K) + ((M[h] * m) << J) + B[h];  a = S >> 16;  z = rectified(a)
//   total = C + sum over h of V[h] * z[h]          (modulo 2^32; unit h = clock h / UNITS, place h % UNITS)
//
// B and C hold the halves that round (2^15, 2^(T-1)); with XBITS = 16, x stands for x - 2^15 (its top bit inverted), so that a signed
// multiplier does, and B holds what that takes away. The generator does both: quant/export/rtl_schedule.py.
// FOLD = 1: weights are constants and products are shifts and adds. FOLD > 1: weights in small memories, 8 UNITS multipliers,
// a register before and after each.
//
// load: a new window is at e and m; it stays for FOLD clocks. load comes every FOLD clocks.
// Latency: total is there at load + LATENCY, for one clock: FOLD + 5 + (FOLD > 1) + RECTIFY + ceil(log2 UNITS).
module upb_network_parallel #(
    parameter integer XBITS = 16,
    parameter integer WBITS = 8,
    parameter integer UNITS = 1,
    parameter integer FOLD = 12,
    parameter integer K = 0,
    parameter integer J = 0,
    parameter integer SLOPE = 0,
    parameter integer RECTIFY = 1,
    parameter [31:0] C = 32'd0,
    parameter [FOLD*UNITS*6*WBITS-1:0] W = 0,
    parameter [FOLD*UNITS*16-1:0] M = 0,
    parameter [FOLD*UNITS*32-1:0] B = 0,
    parameter [FOLD*UNITS*WBITS-1:0] V = 0,
    parameter integer WRITABLE = 0   // FOLD > 1: weights can be written; see upb_memory
) (
    input  wire               clk,
    input  wire               rst,
    input  wire               load,
    input  wire               bank,    // WRITABLE: of the weights, with load
    input  wire [       44:0] port,
    input  wire [6*XBITS-1:0] e,
    input  wire [  XBITS-1:0] m,
    output wire [       31:0] total
);
    localparam integer READ = FOLD > 1 ? 1 : 0;       // reading the weights
    localparam integer TO_V = READ + 4 + RECTIFY;     // load to the first z
    localparam integer TREE = UNITS > 1 ? $clog2(UNITS) : 0;
    localparam integer TO_SUM = TO_V + 1 + TREE;      // load to the first sum of products V * z
    localparam integer BITS = FOLD > 1 ? $clog2(FOLD) : 1;
    localparam integer XS = XBITS == 16 ? 16 : XBITS + 1;

    wire [TO_SUM:0] loaded;
    upb_strobes #(.DEPTH(TO_SUM)) times (.clk(clk), .rst(rst), .d(load), .tap(loaded));

    // ------------------------------------------------------------------ which bank, and C
    // The bank of a window is there with its load and goes along with it.
    wire now_bank, v_bank;
    wire [31:0] c_now;
    generate
        if (WRITABLE == 0) begin : one_bank
            assign {now_bank, v_bank} = 2'b00;
            assign c_now = C;
        end else begin : two_banks
            reg kept_bank;
            wire sum_bank;
            reg [31:0] c0 = C, c1 = C;
            always @(posedge clk) begin
                kept_bank <= now_bank;
                if (port[43] && port[42:40] == 3'd4)
                    if (port[44]) c1 <= port[31:0];
                    else c0 <= port[31:0];
            end
            assign now_bank = load ? bank : kept_bank;
            upb_shift #(.WIDTH(1), .DEPTH(TO_V - 1)) to_v (.clk(clk), .d(now_bank), .q(v_bank));
            upb_shift #(.WIDTH(1), .DEPTH(TO_SUM)) to_sum (.clk(clk), .d(now_bank), .q(sum_bank));
            assign c_now = sum_bank ? c1 : c0;
        end
    endgenerate

    // ------------------------------------------------------------------ weights, one word a clock
    wire [UNITS*6*WBITS-1:0] w_now;
    wire [UNITS*16-1:0] m_now;
    wire [UNITS*32-1:0] b_now;
    wire [UNITS*WBITS-1:0] v_now;
    wire [6*XBITS-1:0] operands, e_now;
    wire [XBITS-1:0] m_in;
    // 16 bits are given to a signed multiplier less 2^15; inverted here, before the register, so that none stands after it.
    function automatic [XBITS-1:0] operand(input [XBITS-1:0] x);
        operand = {x[XBITS-1] ^ (XBITS == 16), x[XBITS-2:0]};
    endfunction
    generate
        for (genvar i = 0; i < 6; i = i + 1) begin : given
            assign operands[i*XBITS +: XBITS] = operand(e[i*XBITS +: XBITS]);
        end
        if (FOLD == 1) begin : constant
            assign w_now = W;
            assign m_now = M;
            assign b_now = B;
            assign v_now = V;
            assign e_now = operands;
            assign m_in = operand(m);
        end else begin : memory
            reg [BITS-1:0] step, v_step;
            wire [BITS-1:0] at = load ? {BITS{1'b0}} : step;
            wire [BITS-1:0] v_at = loaded[TO_V-1] ? {BITS{1'b0}} : v_step;
            always @(posedge clk)
                if (rst) {v_step, step} <= {(2 * BITS) {1'b0}};
                else begin
                    step <= at == FOLD - 1 ? {BITS{1'b0}} : at + 1'b1;
                    v_step <= v_at == FOLD - 1 ? {BITS{1'b0}} : v_at + 1'b1;
                end
            upb_memory #(.WIDTH(UNITS * 6 * WBITS), .DEPTH(FOLD), .ADDRESS(BITS), .INIT(W), .WRITABLE(WRITABLE), .SELECT(3'd0)) rom_w (
                .clk(clk), .bank(now_bank), .port(port), .address(at), .q(w_now)
            );
            upb_memory #(.WIDTH(UNITS * 16), .DEPTH(FOLD), .ADDRESS(BITS), .INIT(M), .WRITABLE(WRITABLE), .SELECT(3'd1)) rom_m (
                .clk(clk), .bank(now_bank), .port(port), .address(at), .q(m_now)
            );
            wire [UNITS*32-1:0] b_read;
            upb_memory #(.WIDTH(UNITS * 32), .DEPTH(FOLD), .ADDRESS(BITS), .INIT(B), .WRITABLE(WRITABLE), .SELECT(3'd2)) rom_b (
                .clk(clk), .bank(now_bank), .port(port), .address(at), .q(b_read)
            );
            upb_shift #(.WIDTH(UNITS * 32), .DEPTH(1)) late_b (.clk(clk), .d(b_read), .q(b_now));
            upb_memory #(.WIDTH(UNITS * WBITS), .DEPTH(FOLD), .ADDRESS(BITS), .INIT(V), .WRITABLE(WRITABLE), .SELECT(3'd3)) rom_v (
                .clk(clk), .bank(v_bank), .port(port), .address(v_at), .q(v_now)
            );
            upb_shift #(.WIDTH(6 * XBITS), .DEPTH(1)) late_e (.clk(clk), .d(operands), .q(e_now));
            upb_shift #(.WIDTH(XBITS), .DEPTH(1)) late_m (.clk(clk), .d(operand(m)), .q(m_in));
        end
    endgenerate

    // ------------------------------------------------------------------ products
    localparam integer PW = XS + WBITS;  // of a product W * e
    localparam integer PM = XS + 16;
    wire [UNITS*32-1:0] vz;
    generate
        for (genvar u = 0; u < UNITS; u = u + 1) begin : unit
            wire signed [6*PW-1:0] p;
            wire signed [PM-1:0] pm, pm_less;
            reg  [6*PW-1:0] p1;
            reg  signed [PM-1:0] pm1, pm_less1;  // the product of M is their difference
            for (genvar i = 0; i < 6; i = i + 1) begin : input_
                wire signed [XS-1:0] x = e_now[i*XBITS +: XBITS];  // eight bits are positive
                if (FOLD == 1) begin : baked
                    localparam signed [WBITS-1:0] WEIGHT = W[(6*u+i)*WBITS +: WBITS];
                    upb_constant_product #(.IN(XS), .OUT(PW), .FACTOR(WEIGHT)) product (
                        .x(x), .added(), .taken(), .product(p[i*PW +: PW])
                    );
                end else begin : multiplied
                    assign p[i*PW +: PW] = x * $signed(w_now[(6*u+i)*WBITS +: WBITS]);
                end
            end
            wire signed [XS-1:0] least = m_in;
            if (FOLD == 1) begin : baked_m
                localparam signed [15:0] WEIGHT = M[u*16 +: 16];
                // Up to eight digits: the last sum is left to the next clock.
                upb_constant_product #(.IN(XS), .OUT(PM), .FACTOR(WEIGHT)) product (
                    .x(least), .added(pm), .taken(pm_less), .product()
                );
            end else begin : multiplied_m
                assign pm = least * $signed(m_now[u*16 +: 16]);
                assign pm_less = {PM{1'b0}};
            end

            // S, modulo 2^32, as a tree of three levels. Only its upper half goes on.
            wire signed [PW-1:0] q0 = $signed(p1[0 +: PW]), q1 = $signed(p1[PW +: PW]), q2 = $signed(p1[2*PW +: PW]);
            wire signed [PW-1:0] q3 = $signed(p1[3*PW +: PW]), q4 = $signed(p1[4*PW +: PW]);
            wire signed [PW-1:0] q5 = $signed(p1[5*PW +: PW]);
            reg signed [PW:0] s01, s23, s45;
            reg signed [PW+1:0] s0123;
            reg [31:0] mb, s45mb, S;
            wire signed [31:0] wide_m = pm1, wide_less = pm_less1, wide_45 = s45, wide_0123 = s0123;
            always @(posedge clk) begin
                p1 <= p;
                pm1 <= pm;
                pm_less1 <= pm_less;
                s01 <= q0 + q1;
                s23 <= q2 + q3;
                s45 <= q4 + q5;
                mb <= (wide_m <<< J) - (wide_less <<< J) + b_now[u*32 +: 32];
                s0123 <= s01 + s23;
                s45mb <= (wide_45 <<< K) + mb;
                S <= (wide_0123 <<< K) + s45mb;
            end

            wire [15:0] z;
            upb_rectifier #(.SLOPE(SLOPE), .LATENCY(RECTIFY)) rectifier (.clk(clk), .enable(1'b1), .a(S[31:16]), .z(z));

            wire signed [16+WBITS-1:0] pv;
            reg  signed [16+WBITS-1:0] pv1;
            if (FOLD == 1) begin : baked_v
                localparam signed [WBITS-1:0] WEIGHT = V[u*WBITS +: WBITS];
                upb_constant_product #(.IN(16), .OUT(16 + WBITS), .FACTOR(WEIGHT)) product (
                    .x(z), .added(), .taken(), .product(pv)
                );
            end else begin : multiplied_v
                assign pv = $signed(z) * $signed(v_now[u*WBITS +: WBITS]);
            end
            always @(posedge clk) pv1 <= pv;
            wire signed [31:0] wide_v = pv1;
            assign vz[u*32 +: 32] = wide_v;
        end
    endgenerate

    // ------------------------------------------------------------------ the output's sum
    wire [31:0] products;
    upb_sum #(.N(UNITS), .WIDTH(32)) tree (.clk(clk), .terms(vz), .total(products));
    reg [31:0] sum;
    always @(posedge clk) sum <= (loaded[TO_SUM] ? c_now : sum) + products;
    assign total = sum;
endmodule
