// upb_network: LANES windows side by side, each FOLD clocks; a new window every FOLD / LANES clocks (`strobe`), their totals in the
// same order. Windows go to the lanes in turn, so that all lanes keep one fixed schedule and nothing is reordered.
//
// Latency: that of the unit inside; with more than one lane two clocks more: to keep the window, and to choose the total.
// The total is there for at least one clock.
module upb_network #(
    parameter integer LANES = 1,
    parameter integer FOLD = 12,
    parameter integer HIDDEN = 12,
    parameter integer XBITS = 16,
    parameter integer WBITS = 8,
    parameter integer K = 0,
    parameter integer J = 0,
    parameter integer SLOPE = 0,
    parameter integer RECTIFY = 1,   // clocks of the rectifier: 2 where either network is leaky
    parameter [31:0] C = 32'd0,
    parameter integer UNITS = 1,     // FOLD <= HIDDEN: hidden units a clock
    parameter integer PHASES = 1,    // FOLD > HIDDEN: clocks a hidden unit
    parameter integer BEHIND = 1,
    parameter integer WORDS_W = 1, WORDS_M = 1, WORDS_B = 1, WORDS_V = 1,  // bits of the weights below
    parameter [WORDS_W-1:0] W = 0,   // FOLD > HIDDEN: all weights in the order of the schedule
    parameter [WORDS_M-1:0] M = 0,
    parameter [WORDS_B-1:0] B = 0,
    parameter [WORDS_V-1:0] V = 0,
    parameter integer WRITABLE = 0
) (
    input  wire               clk,
    input  wire               rst,
    input  wire               strobe,
    input  wire               bank,    // WRITABLE: of the weights, with strobe
    input  wire [       44:0] port,
    input  wire               chosen,  // strobe, LATENCY - 1 clocks later; of no use with one lane
    input  wire [6*XBITS-1:0] e,
    input  wire [  XBITS-1:0] m,
    output wire [       31:0] total
);
    localparam integer LANE_BITS = LANES > 1 ? $clog2(LANES) : 1;
    wire [LANES*32-1:0] totals;
    generate
        for (genvar l = 0; l < LANES; l = l + 1) begin : lane
            wire load, bank_in;
            wire [6*XBITS-1:0] e_in;
            wire [XBITS-1:0] m_in;
            if (LANES == 1) begin : all
                assign load = strobe;
                assign bank_in = bank;
                assign e_in = e;
                assign m_in = m;
            end else begin : mine
                reg loaded, bank_kept;
                reg [6*XBITS-1:0] e_kept;
                reg [XBITS-1:0] m_kept;
                reg [LANE_BITS-1:0] turn;
                wire my_turn = strobe && turn == l;
                always @(posedge clk) begin
                    loaded <= my_turn && !rst;
                    if (my_turn) begin
                        e_kept <= e;
                        m_kept <= m;
                        bank_kept <= bank;
                    end
                    if (rst) turn <= {LANE_BITS{1'b0}};
                    else if (strobe) turn <= turn == LANES - 1 ? {LANE_BITS{1'b0}} : turn + 1'b1;
                end
                assign load = loaded;
                assign bank_in = bank_kept;
                assign e_in = e_kept;
                assign m_in = m_kept;
            end
            if (PHASES == 1) begin : parallel
                upb_network_parallel #(
                    .XBITS(XBITS), .WBITS(WBITS), .UNITS(UNITS), .FOLD(FOLD), .K(K), .J(J), .SLOPE(SLOPE),
                    .RECTIFY(RECTIFY), .C(C), .W(W), .M(M), .B(B), .V(V), .WRITABLE(WRITABLE)
                ) unit (
                    .clk(clk), .rst(rst), .load(load), .bank(bank_in), .port(port), .e(e_in), .m(m_in), .total(totals[l*32 +: 32])
                );
            end else begin : serial
                upb_network_serial #(
                    .XBITS(XBITS), .WBITS(WBITS), .HIDDEN(HIDDEN), .PHASES(PHASES), .BEHIND(BEHIND), .K(K), .J(J),
                    .SLOPE(SLOPE), .RECTIFY(RECTIFY), .C(C), .X(W), .B(B), .WRITABLE(WRITABLE)
                ) unit (
                    .clk(clk), .rst(rst), .load(load), .bank(bank_in), .port(port), .e(e_in), .m(m_in), .total(totals[l*32 +: 32])
                );
            end
        end
        if (LANES == 1) begin : only
            assign total = totals;
        end else begin : choose
            reg [LANE_BITS-1:0] turn;
            reg [31:0] kept;
            always @(posedge clk) begin
                kept <= totals[turn*32 +: 32];
                if (rst) turn <= {LANE_BITS{1'b0}};
                else if (chosen) turn <= turn == LANES - 1 ? {LANE_BITS{1'b0}} : turn + 1'b1;
            end
            assign total = kept;
        end
    endgenerate
endmodule
