`include "upb_check.svh"
// upb_core: 32-beam columns in, 64-row columns out, to the bit of the integer contract (docs/numeric-contract.md).
//
//   s_axis -> skid -> receiver -> columns -> fill -> minimum -> block code -> networks -> output -> FIFO -> m_axis
//
// In:  s_axis_tdata = {intensity[7:0], distance[15:0]}, one beam a beat, beam 0 first; tlast with beam 31;
//      tuser[0] with the first beat of a frame; tuser[1] with the last beat of a column after which the stream ends (an edge),
//      with any other beat of a column that never arrived and was inserted: it counts as incomplete.
// Out: m_axis_tdata = {generated intensity, generated distance, sensor intensity, sensor distance}: rows 2 k + 1 and 2 k at beat k;
//      tlast with beat 31; tuser[0] with the first beat of a frame, tuser[1] in columns that came incomplete.
// Column c leaves while column c + 1 arrives, or after it an edge. A beat is taken every FOLD / LANES clocks.
//
// The pipeline runs freely: a slot comes every FOLD / LANES clocks, with a beat or without, and everything after it is a fixed number of
// clocks later. Nothing stalls; beats are taken only while the FIFO has room for all that is on its way. s_axis_tready is a function
// of registers alone. Latencies: docs/fpga.md; power/cycles/fpga_core.py calculates them.
module upb_core #(
    parameter integer LANES = upb_pkg::UPB_LANES,
    parameter integer FOLD = upb_pkg::UPB_FOLD,
    parameter integer WRITABLE = 0     // weights in memories that can be written (upb_top), not in ROMs; the same timing
) (
    input  wire        aclk,
    input  wire        aresetn,           // synchronous, low: reset, for at least 64 clocks
    input  wire [15:0] cfg_columns,       // columns of a frame; changes only in reset

    input  wire [23:0] s_axis_tdata,
    input  wire        s_axis_tvalid,
    output wire        s_axis_tready,
    input  wire        s_axis_tlast,
    input  wire [ 1:0] s_axis_tuser,

    output wire [47:0] m_axis_tdata,
    output wire        m_axis_tvalid,
    input  wire        m_axis_tready,
    output wire        m_axis_tlast,
    output wire [ 1:0] m_axis_tuser,

    // Events: one clock each. See upb_receiver for what they mean.
    output wire        ev_column,         // a column came whole
    output wire        ev_frame,          // the first beat of a frame was taken
    output wire        ev_short_column,
    output wire        ev_long_column,
    output wire        ev_short_frame,
    output wire        ev_long_frame,
    output wire        ev_dropped,        // a beat was dropped while waiting for a frame
    output wire        ev_overrun,        // the FIFO lost a beat: never, by construction

    // WRITABLE: weights in two banks. The first window of a frame changes banks while weights_swap is high; ev_swapped: no window
    // of the old one is under way, weights_swap may fall.
    input  wire [44:0] weights,           // {write, word address[11:0], data}: to the bank that is not in use
    input  wire        weights_bank,      // in use after reset
    input  wire        weights_swap,
    output wire        ev_swapped
);
    localparam integer HIDDEN = upb_pkg::UPB_HIDDEN;
    localparam integer INTERVAL = FOLD / (LANES < 1 ? 1 : LANES);  // clocks between slots
    localparam integer UNITS = FOLD <= HIDDEN ? (HIDDEN + FOLD - 1) / FOLD : 1;
    localparam integer PHASES = FOLD <= HIDDEN ? 1 : FOLD / HIDDEN;
    localparam integer RECTIFY = upb_pkg::UPB_DISTANCE_SLOPE > 0 || upb_pkg::UPB_INTENSITY_SLOPE > 0 ? 2 : 1;
    localparam integer BEHIND = (RECTIFY + 5 + PHASES - 1) / PHASES;

    `UPB_REQUIRE(HIDDEN >= 1 && HIDDEN <= 32, bad_hidden, "upb_core: hidden units must be 1 to 32")
    `UPB_REQUIRE(FOLD >= 1 && (FOLD <= HIDDEN || FOLD == 2 * HIDDEN || FOLD == 4 * HIDDEN || FOLD == 8 * HIDDEN),
                 bad_fold, "upb_core: FOLD must be at most the hidden units, or 2, 4 or 8 times them")
    `UPB_REQUIRE(LANES >= 1 && FOLD % (LANES < 1 ? 1 : LANES) == 0, bad_lanes,
                 "upb_core: LANES must divide FOLD, both at least 1")
    `UPB_REQUIRE(FOLD == upb_pkg::UPB_FOLD, other_fold,
                 "upb_core: FOLD is not the one that upb_config.svh was generated for")
    `UPB_REQUIRE(upb_pkg::UPB_WEIGHT_BITS == (upb_pkg::UPB_BLOCK_CODE != 0 ? 8 : 16), bad_precision,
                 "upb_core: weights must have 8 bits with the block code (int8) and 16 without (int16)")
    `UPB_REQUIRE(upb_pkg::UPB_CONFIG_CRC32 == upb_pkg::UPB_MODEL_CRC32, other_model,
                 "upb_core: upb_config.svh and upb_params.svh are of different models")
    `UPB_REQUIRE(WRITABLE == 0 || FOLD > 1, bad_writable, "upb_core: WRITABLE needs FOLD > 1: with FOLD 1 weights are constants")
    `UPB_REQUIRE(WRITABLE == 0 || FOLD <= HIDDEN || LANES == 1, bad_writable_lanes,
                 "upb_core: WRITABLE with FOLD beyond the hidden units needs LANES 1")

    // ------------------------------------------------------------------ times, in clocks after the slot
    localparam integer NETWORK = PHASES == 1
        ? FOLD + 5 + (FOLD > 1 ? 1 : 0) + RECTIFY + (UNITS > 1 ? $clog2(UNITS) : 0) + (LANES > 1 ? 2 : 0)
        : FOLD + BEHIND * PHASES + 3 + (LANES > 1 ? 2 : 0);
    localparam integer CODE = upb_pkg::UPB_BLOCK_CODE != 0 ? 3 : 0;
    localparam integer AT_COLUMNS = 1;
    localparam integer AT_WINDOW = AT_COLUMNS + 2;
    localparam integer AT_FILLED = AT_WINDOW + (upb_pkg::UPB_EMPTY_FILL != 0 ? 3 : 0);
    localparam integer AT_MINIMUM = AT_FILLED + 3;
    localparam integer AT_CODE = AT_MINIMUM + CODE;
    localparam integer AT_GREY = AT_MINIMUM + NETWORK;
    localparam integer AT_TOTAL = AT_CODE + NETWORK;
    localparam integer AT_WRITE = AT_TOTAL + 3;
    localparam integer ON_THE_WAY = AT_WRITE / INTERVAL + 5;
    localparam integer FIFO_DEPTH = 1 << $clog2(ON_THE_WAY + 8);
    localparam integer RING_DEPTH = 1 << $clog2(AT_TOTAL / INTERVAL + 3);

    wire clk = aclk;
    reg rst;
    always @(posedge clk) rst <= !aresetn;

    // ------------------------------------------------------------------ slots
    localparam integer SLOT_BITS = INTERVAL > 1 ? $clog2(INTERVAL) : 1;
    reg [SLOT_BITS-1:0] count;
    reg slot;  // high in reset too, where nothing listens
    wire [AT_WRITE:0] at;
    wire turns = count == INTERVAL - 1;
    always @(posedge clk)
        if (rst) begin
            count <= {SLOT_BITS{1'b0}};
            slot <= 1'b1;
        end else begin
            count <= turns ? {SLOT_BITS{1'b0}} : count + 1'b1;
            slot <= turns;
        end
    upb_strobes #(.DEPTH(AT_WRITE)) times (.clk(clk), .rst(rst), .d(slot), .tap(at));

    // ------------------------------------------------------------------ columns
    wire in_valid, in_ready, room;
    wire [26:0] in_data;
    upb_skid #(.WIDTH(27)) skid (
        .clk(clk), .rst(rst),
        .in_valid(s_axis_tvalid), .in_ready(s_axis_tready), .in_data({s_axis_tuser, s_axis_tlast, s_axis_tdata}),
        .out_valid(in_valid), .out_ready(in_ready), .out_data(in_data)
    );

    wire beat, real_, padded, first;
    wire [4:0] beam;
    wire [23:0] data;
    upb_receiver #(.EDGE_SEAM(upb_pkg::UPB_EDGE_SEAM)) receiver (
        .clk(clk), .rst(rst), .columns(cfg_columns), .slot(slot), .room(room),
        .in_valid(in_valid), .in_ready(in_ready), .in_data(in_data),
        .beat(beat), .real_(real_), .padded(padded), .first(first), .beam(beam), .data(data),
        .ev_column(ev_column), .ev_frame(ev_frame), .ev_short_column(ev_short_column), .ev_long_column(ev_long_column),
        .ev_short_frame(ev_short_frame), .ev_long_frame(ev_long_frame), .ev_dropped(ev_dropped)
    );

    wire [5:0] seen;
    wire [95:0] window;
    wire [47:0] window_grey;
    wire [23:0] own;
    wire [4:0] row;
    wire valid, starts, tail, incomplete;
    upb_columns #(.MIN_COUNT(upb_pkg::UPB_MIN_COUNT), .SEEN_MAX(upb_pkg::UPB_SEEN_MAX)) columns (
        .clk(clk), .rst(rst), .strobe(at[AT_COLUMNS]),
        .beat(beat), .real_(real_), .padded(padded), .first(first), .beam(beam), .data(data),
        .seen(seen), .distance(window), .intensity(window_grey), .own(own), .row(row),
        .valid(valid), .starts(starts), .tail(tail), .incomplete(incomplete)
    );

    // ------------------------------------------------------------------ steps 1 to 3
    wire [95:0] filled, d, e;
    wire [47:0] filled_grey, d_grey;
    wire [15:0] m;
    wire [7:0] m_grey;
    upb_fill #(.WIDTH(16), .ENABLE(upb_pkg::UPB_EMPTY_FILL)) fill (
        .clk(clk), .seen(seen), .x(window), .filled(filled)
    );
    upb_fill #(.WIDTH(8), .ENABLE(upb_pkg::UPB_EMPTY_FILL)) fill_grey (
        .clk(clk), .seen(seen), .x(window_grey), .filled(filled_grey)
    );
    upb_minimum #(.WIDTH(16)) minimum (.clk(clk), .x(filled), .m(m), .d(d));
    upb_minimum #(.WIDTH(8)) minimum_grey (.clk(clk), .x(filled_grey), .m(m_grey), .d(d_grey));
    upb_block_code #(.ENABLE(upb_pkg::UPB_BLOCK_CODE)) block_code (.clk(clk), .d(d), .e(e));
    wire [15:0] m_late;
    upb_shift #(.WIDTH(16), .DEPTH(CODE)) late_m (.clk(clk), .d(m), .q(m_late));

    // ------------------------------------------------------------------ banks of weights
    wire [44:0] port, port_grey;
    wire bank_code, bank_minimum;
    generate
        if (WRITABLE == 0) begin : baked
            assign {port, port_grey} = 90'd0;
            assign {bank_code, bank_minimum, ev_swapped} = 3'b000;
        end else begin : banks
            localparam integer DRAIN = AT_WRITE - AT_WINDOW;
            reg bank, swapped;
            reg [$clog2(DRAIN+1)-1:0] drain;
            reg [44:0] port_r, port_grey_r;
            wire change = at[AT_WINDOW] && valid && starts && weights_swap && !swapped;
            always @(posedge clk) begin
                if (change) bank <= !bank;
                if (change) drain <= DRAIN;
                else if (drain != 0) drain <= drain - 1'b1;
                swapped <= weights_swap && (swapped || change);
                port_r <= {!bank, weights[44] && !weights[43], weights[42:32], weights[31:0]};
                port_grey_r <= {!bank, weights[44] && weights[43], weights[42:32], weights[31:0]};
                if (rst) begin
                    bank <= weights_bank;
                    swapped <= 1'b0;
                    drain <= 0;
                end
            end
            assign ev_swapped = drain == 1;
            assign port = port_r;
            assign port_grey = port_grey_r;
            upb_shift #(.WIDTH(1), .DEPTH(AT_MINIMUM - AT_WINDOW - 1)) to_minimum (.clk(clk), .d(bank), .q(bank_minimum));
            upb_shift #(.WIDTH(1), .DEPTH(AT_CODE - AT_WINDOW - 1)) to_code (.clk(clk), .d(bank), .q(bank_code));
        end
    endgenerate

    // ------------------------------------------------------------------ steps 4 to 7
    wire [31:0] total, total_grey;
    upb_network #(
        .LANES(LANES), .FOLD(FOLD), .HIDDEN(HIDDEN), .XBITS(16), .WBITS(upb_pkg::UPB_WEIGHT_BITS),
        .K(upb_pkg::UPB_DISTANCE_K), .J(upb_pkg::UPB_DISTANCE_J), .SLOPE(upb_pkg::UPB_DISTANCE_SLOPE),
        .RECTIFY(RECTIFY), .C(upb_pkg::UPB_DISTANCE_STEP_C), .UNITS(UNITS), .PHASES(PHASES), .BEHIND(BEHIND),
        .WORDS_W(upb_pkg::UPB_STEP_W_BITS), .WORDS_M(upb_pkg::UPB_STEP_M_BITS),
        .WORDS_B(upb_pkg::UPB_STEP_B_BITS), .WORDS_V(upb_pkg::UPB_STEP_V_BITS),
        .W(upb_pkg::UPB_DISTANCE_STEP_W), .M(upb_pkg::UPB_DISTANCE_STEP_M),
        .B(upb_pkg::UPB_DISTANCE_STEP_B), .V(upb_pkg::UPB_DISTANCE_STEP_V), .WRITABLE(WRITABLE)
    ) distance (
        .clk(clk), .rst(rst), .strobe(at[AT_CODE]), .chosen(at[AT_TOTAL-1]), .bank(bank_code), .port(port),
        .e(e), .m(m_late), .total(total)
    );
    upb_network #(
        .LANES(LANES), .FOLD(FOLD), .HIDDEN(HIDDEN), .XBITS(8), .WBITS(upb_pkg::UPB_WEIGHT_BITS),
        .K(upb_pkg::UPB_INTENSITY_K), .J(upb_pkg::UPB_INTENSITY_J), .SLOPE(upb_pkg::UPB_INTENSITY_SLOPE),
        .RECTIFY(RECTIFY), .C(upb_pkg::UPB_INTENSITY_STEP_C), .UNITS(UNITS), .PHASES(PHASES), .BEHIND(BEHIND),
        .WORDS_W(upb_pkg::UPB_STEP_W_BITS), .WORDS_M(upb_pkg::UPB_STEP_M_BITS),
        .WORDS_B(upb_pkg::UPB_STEP_B_BITS), .WORDS_V(upb_pkg::UPB_STEP_V_BITS),
        .W(upb_pkg::UPB_INTENSITY_STEP_W), .M(upb_pkg::UPB_INTENSITY_STEP_M),
        .B(upb_pkg::UPB_INTENSITY_STEP_B), .V(upb_pkg::UPB_INTENSITY_STEP_V), .WRITABLE(WRITABLE)
    ) intensity (
        .clk(clk), .rst(rst), .strobe(at[AT_MINIMUM]), .chosen(at[AT_GREY-1]), .bank(bank_minimum), .port(port_grey),
        .e(d_grey), .m(m_grey), .total(total_grey)
    );

    // ------------------------------------------------------------------ what goes past the networks
    wire [32:0] passed;
    wire [15:0] m_passed;
    wire [7:0] m_grey_passed;
    upb_ring #(.WIDTH(33), .DEPTH(RING_DEPTH)) past (
        .clk(clk), .rst(rst), .put(at[AT_WINDOW]), .d({valid, starts, tail, incomplete, row, own}),
        .get(at[AT_TOTAL-1]), .q(passed)
    );
    upb_ring #(.WIDTH(16), .DEPTH(RING_DEPTH)) past_m (
        .clk(clk), .rst(rst), .put(at[AT_MINIMUM]), .d(m), .get(at[AT_TOTAL-1]), .q(m_passed)
    );
    upb_ring #(.WIDTH(8), .DEPTH(RING_DEPTH)) past_m_grey (
        .clk(clk), .rst(rst), .put(at[AT_MINIMUM]), .d(m_grey), .get(at[AT_GREY-1]), .q(m_grey_passed)
    );
    wire out_valid = passed[32], out_starts = passed[31], out_tail = passed[30], out_incomplete = passed[29];

    // ------------------------------------------------------------------ steps 8 and 9, and out
    wire [47:0] out_beat;
    upb_output #(
        .EARLY(CODE), .MIN_COUNT(upb_pkg::UPB_MIN_COUNT), .GIVEN_MAX(upb_pkg::UPB_GIVEN_MAX),
        .EMPTY_FILL(upb_pkg::UPB_EMPTY_FILL), .LAST_ROW_EMPTY(upb_pkg::UPB_LAST_ROW_EMPTY),
        .DISTANCE_T(upb_pkg::UPB_DISTANCE_T), .DISTANCE_SKIP(upb_pkg::UPB_DISTANCE_SKIP),
        .INTENSITY_T(upb_pkg::UPB_INTENSITY_T), .INTENSITY_SKIP(upb_pkg::UPB_INTENSITY_SKIP)
    ) out_unit (
        .clk(clk), .distance_total(total), .distance_m(m_passed),
        .intensity_total(total_grey), .intensity_m(m_grey_passed),
        .row(passed[28:24]), .tail(out_tail), .own(passed[23:0]), .beat(out_beat)
    );
    wire [3:0] mark;
    upb_shift #(.WIDTH(4), .DEPTH(3)) marks (
        .clk(clk), .d({out_valid, out_incomplete, out_starts, out_tail}), .q(mark)
    );
    upb_fifo #(.WIDTH(51), .DEPTH(FIFO_DEPTH), .SLACK(ON_THE_WAY)) fifo (
        .clk(clk), .rst(rst), .write(at[AT_WRITE] && mark[3]), .in_data({mark[2:0], out_beat}),
        .room(room), .overrun(ev_overrun),
        .out_valid(m_axis_tvalid), .out_ready(m_axis_tready),
        .out_data({m_axis_tuser, m_axis_tlast, m_axis_tdata})
    );
endmodule
