`include "upb_check.svh"
// upb_destagger: firing columns in, azimuth columns out; what the ring of runtime/src/upb_stream.c does, in a stream.
//
//   azimuth column a, beam k = firing column a - offset(k), beam k;  offset(k) = lag(k) - DELAY, lag 0 to SLOTS - 1
//
// Column a leaves, beat for beat, while firing column a + DELAY comes in: each beam waits lag(k) columns in a memory of SLOTS columns
// of 32 pixels. A beam whose firing column never was (before the stream's begin, behind its end, marked as missing) is empty, and its
// column is marked incomplete. LAG, SLOTS and DELAY come of the model's beam table: upb_beams.svh.
//
// In and out: beats as upb_core takes them; in addition tuser[1] with any beat but the last of a column: the column is incomplete
// (inserted for one that never arrived). A frame begins with firing column 0.
//
// After an error of framing (the events of upb_receiver, of which upb_core then sees none) or the end of the stream the DELAY
// columns still under way leave, the last one marked as the stream's end; then everything is dropped until the next frame.
// Latency: 3 clocks from a beat to the beat that leaves with it; no path from m_axis_tready to s_axis_tready.
module upb_destagger #(
    parameter integer SLOTS = 2,
    parameter integer DELAY = 1,
    parameter [32*16-1:0] LAG = {16'd1, 496'd0}
) (
    input  wire        clk,
    input  wire        rst,
    input  wire [15:0] columns,         // of a frame

    input  wire [23:0] s_axis_tdata,
    input  wire        s_axis_tvalid,
    output wire        s_axis_tready,
    input  wire        s_axis_tlast,
    input  wire [ 1:0] s_axis_tuser,

    output wire [23:0] m_axis_tdata,
    output wire        m_axis_tvalid,
    input  wire        m_axis_tready,
    output wire        m_axis_tlast,
    output wire [ 1:0] m_axis_tuser,

    output reg         ev_short_column,
    output reg         ev_long_column,
    output reg         ev_short_frame,
    output reg         ev_long_frame,
    output reg         ev_dropped
);
    function automatic integer widest(input integer unused);
        integer n;
        begin
            widest = 0;
            for (n = 0; n < 32; n = n + 1) if (LAG[16*n +: 16] > widest) widest = LAG[16*n +: 16];
        end
    endfunction
    `UPB_REQUIRE(SLOTS >= 2 && SLOTS <= 1024, bad_slots, "upb_destagger: SLOTS must be 2 to 1024 columns")
    `UPB_REQUIRE(DELAY >= 1 && DELAY < SLOTS, bad_delay,
                 "upb_destagger: DELAY must be 1 to SLOTS - 1: azimuth offsets on both sides of 0")
    `UPB_REQUIRE(widest(0) == SLOTS - 1, bad_lag, "upb_destagger: the largest lag must be SLOTS - 1")

    localparam integer BITS = $clog2(SLOTS);
    localparam [1:0] SYNC = 2'd0, RUN = 2'd1, PAD = 2'd2, FLUSH = 2'd3;

    wire in_valid, in_ready;
    wire [26:0] in_data;
    upb_skid #(.WIDTH(27)) front (
        .clk(clk), .rst(rst),
        .in_valid(s_axis_tvalid), .in_ready(s_axis_tready), .in_data({s_axis_tuser, s_axis_tlast, s_axis_tdata}),
        .out_valid(in_valid), .out_ready(in_ready), .out_data(in_data)
    );
    wire last = in_data[24];
    wire starts = in_data[25];
    wire ends = in_data[26];

    // ------------------------------------------------------------------ which beat is next
    reg [1:0] state;
    reg [4:0] beam;
    reg [BITS-1:0] slot;             // that the firing column goes to
    reg [15:0] taken, given;         // columns of the frame, in firing and in azimuth order
    reg [BITS-1:0] waiting;          // firing columns until the first azimuth column is complete
    reg [BITS-1:0] left;             // columns to flush
    reg cut;                         // the column is short: flush after it
    reg [SLOTS-2:0] stored, whole;   // bit n: the firing column n + 1 ago: has data, was complete
    reg whole_now;                   // the column at hand

    wire top = beam == 5'd0;
    wire bottom = beam == 5'd31;
    wire move;                       // the stage below takes a beat
    wire head = move && in_valid;
    wire cut_column = starts && !top;
    wire cut_frame = starts && top && taken != columns && taken != 16'd0;
    wire beyond = !starts && top && taken == columns;
    wire take = state == RUN && head && !(cut_column || cut_frame || beyond);
    wire drop = state == SYNC && head && !starts;
    assign in_ready = take || drop;
    wire step = take || (move && (state == PAD || state == FLUSH));  // a beat of a firing column, or of one that never was
    wire closes = step && bottom;
    wire ending = take && bottom && (ends || !last);

    always @(posedge clk) begin
        ev_short_column <= (state == RUN && head && cut_column) || (take && last && !bottom);
        ev_long_column <= take && bottom && !last;
        ev_short_frame <= state == RUN && head && cut_frame;
        ev_long_frame <= state == RUN && head && beyond;
        ev_dropped <= drop;

        if (step) beam <= beam + 5'd1;
        if (closes) begin
            slot <= slot == SLOTS - 1 ? {BITS{1'b0}} : slot + 1'b1;
            stored <= {stored, state != FLUSH};
            whole <= {whole, whole_now && (state == RUN)};
            if (waiting != 0) waiting <= waiting - 1'b1;
            else given <= given + 16'd1 == columns ? 16'd0 : given + 16'd1;
        end
        if (step) whole_now <= state == RUN && !(take && ends && !bottom) && (top || whole_now);

        case (state)
            SYNC:
                if (head && starts) begin
                    state <= RUN;
                    beam <= 5'd0;
                    taken <= 16'd0;
                    given <= 16'd0;
                    waiting <= DELAY;
                    stored <= 0;
                    whole <= 0;
                end
            RUN: begin
                left <= DELAY;
                if (take) begin
                    if (top && starts) taken <= 16'd0;
                    if (bottom) taken <= taken + 16'd1;
                    if (last && !bottom) state <= PAD;
                    else if (ending) state <= FLUSH;
                end else if (head) state <= cut_column ? PAD : FLUSH;
            end
            PAD: if (closes) state <= FLUSH;
            default:
                if (closes) begin
                    left <= left - 1'b1;
                    if (left == 1) state <= SYNC;
                end
        endcase
        if (rst) begin
            state <= SYNC;
            beam <= 5'd0;
            slot <= {BITS{1'b0}};
        end
    end

    // ------------------------------------------------------------------ stage 1: the memory
    wire [BITS-1:0] lag = LAG[16*beam +: BITS];
    wire [BITS-1:0] from = slot >= lag ? slot - lag : slot + SLOTS[BITS-1:0] - lag;
    wire [SLOTS-1:0] there = {stored, state == RUN};
    wire [23:0] arriving = take ? in_data[23:0] : 24'd0;

    reg complete;                    // of the azimuth column that begins
    integer k;
    always @* begin
        complete = 1'b1;
        for (k = 0; k < 32; k = k + 1)
            if (LAG[16*k +: 16] == 16'd0) complete = complete && state == RUN && !ends;
            else complete = complete && whole[LAG[16*k +: 16]-1];
    end

    reg [23:0] memory[0:(1<<BITS)*32-1];
    reg [23:0] read, direct;
    reg full1, direct1, there1, last1, starts1, mark1;
    always @(posedge clk) begin
        if (step) memory[{slot, beam}] <= arriving;
        if (move) begin
            read <= memory[{from, beam}];
            direct <= arriving;
            direct1 <= lag == 0;
            there1 <= there[lag];
            last1 <= bottom;
            starts1 <= top && given == 16'd0;
            if (bottom) mark1 <= state == FLUSH && left == 1;
            else mark1 <= (top && !complete) || state == PAD || (take && last);
            full1 <= step && waiting == 0;
        end
        if (rst) full1 <= 1'b0;
    end

    // ------------------------------------------------------------------ stage 2
    wire back_ready;
    assign move = !full1 || back_ready;
    upb_skid #(.WIDTH(27)) back (
        .clk(clk), .rst(rst), .in_valid(full1), .in_ready(back_ready),
        .in_data({mark1, starts1, last1, !there1 ? 24'd0 : direct1 ? direct : read}),
        .out_valid(m_axis_tvalid), .out_ready(m_axis_tready),
        .out_data({m_axis_tuser, m_axis_tlast, m_axis_tdata})
    );
`ifdef FORMAL
    reg past;
    reg [4:0] sent;      // beat of the column that leaves next
    wire [4:0] underway = sent + full1;
    initial past = 0;
    always @(posedge clk) begin
        past <= 1'b1;
        assume (past || rst);
        if (rst) sent <= 5'd0;
        else if (full1 && back_ready) sent <= sent + 5'd1;
        if (past && !rst && $past(!rst)) begin
            // Columns that leave are whole, whatever came in; each behind a frame's begin.
            if (full1) last_with_beam_31: assert (last1 == (sent == 5'd31));
            whole_columns: assert (underway == (waiting == 0 && state != SYNC ? beam : 5'd0));
            between_columns: assert (state != SYNC || beam == 5'd0);
            slot_within: assert (slot < SLOTS);
            if (full1 && starts1) starts_on_top: assert (sent == 5'd0);
            if ($past(full1 && !back_ready)) stage_holds: assert (full1 && $stable({mark1, starts1, last1, read, direct}));
            if ($past(in_valid && in_ready) && !$past(take)) dropped_is_told: assert (ev_dropped);
            if ($past(take && last && !bottom)) short_is_told: assert (ev_short_column);
            if ($past(ending)) flushes: assert (state == FLUSH);
        end
    end
`endif
endmodule
