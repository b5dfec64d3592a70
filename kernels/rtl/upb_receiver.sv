// upb_receiver: makes whole columns of what arrives.
//
// In:  beats {user[1:0], last, intensity, distance}, one beam each; a column is 32 beats, the last one marked.
//      user[0] on the first beat of a frame; user[1] on the last beat of a column: the stream ends here (an edge); on any other
//      beat: the column is incomplete (inserted for one that never arrived).
// Out: at most one beat a slot, always 32 to a column, beam 0 first; `real_` is low in columns that stand for an edge.
//
// What does not fit is flagged (one-clock events), never passed on as something else:
//   short column   `last` or a new frame before beam 31: the rest of the column is empty, then an edge; then until the next
//                  frame everything is dropped (counted by ev_dropped)
//   long column    no `last` with beam 31: an edge, then dropped until the next frame
//   short frame    a new frame before `columns` columns: an edge lies between
//   long frame     more than `columns` columns: an edge, then dropped until the next frame
// Latency: a beat taken at clock t is at the outputs at t + 1 and stays there until the next.
module upb_receiver #(
    parameter integer EDGE_SEAM = 1
) (
    input  wire        clk,
    input  wire        rst,
    input  wire [15:0] columns,         // of a frame
    input  wire        slot,            // a beat may enter the pipeline at this clock
    input  wire        room,            // and the output has room for what comes of it
    input  wire        in_valid,
    output wire        in_ready,
    input  wire [26:0] in_data,
    output reg         beat,            // valid with the strobe after `slot`
    output reg         real_,
    output reg         padded,          // of the column, valid with its last beat: it was short or marked incomplete
    output reg         first,           // of the column: it begins a frame
    output reg  [ 4:0] beam,
    output reg  [23:0] data,
    output reg         ev_column,
    output reg         ev_frame,
    output reg         ev_short_column,
    output reg         ev_long_column,
    output reg         ev_short_frame,
    output reg         ev_long_frame,
    output reg         ev_dropped
);
    localparam [1:0] SYNC = 2'd0, RUN = 2'd1, PAD = 2'd2, EDGE = 2'd3;

    reg  [ 1:0] state;
    reg         resync;     // after the edge: wait for a new frame
    reg  [ 4:0] next_beam;
    reg  [15:0] done;       // columns of this frame
    reg         some;       // there is one
    reg         nearly;     // the next one is the last: known long before its beam 31
    reg         whole;      // all are there
    reg         marked;     // the column at hand is marked incomplete

    wire        last = in_data[24];
    wire        starts = in_data[25];
    wire        ends = in_data[26];
    wire        top = next_beam == 5'd0;
    wire        bottom = next_beam == 5'd31;
    wire        go = slot && room;
    wire        head = go && in_valid;

    // The beat at hand begins a frame in the middle of a column or of a frame, or is one column too many: it waits.
    wire        cut_column = starts && !top;
    wire        cut_frame = starts && top && !whole && some;
    wire        beyond = !starts && top && whole;
    wire        waits = cut_column || cut_frame || beyond;
    wire        drop = state == SYNC && head && !starts;
    wire        take = state == RUN && head && !waits;
    assign in_ready = take || drop;

    wire closes = take && bottom;
    wire edge_after = ends || (EDGE_SEAM == 0 && nearly);

    always @(posedge clk) begin
        nearly <= done + 16'd1 == columns;
        ev_column <= closes;
        ev_frame <= take && starts;
        ev_short_column <= (state == RUN && head && cut_column) || (take && last && !bottom);
        ev_long_column <= closes && !last;
        ev_short_frame <= state == RUN && head && cut_frame;
        ev_long_frame <= state == RUN && head && beyond;
        ev_dropped <= drop;

        if (slot) begin
            beat <= take || (go && (state == PAD || state == EDGE));
            real_ <= state != EDGE;
            padded <= state == PAD || (marked && !top);
            if (take) marked <= ends && !bottom || marked && !top && !bottom;
            else if (state != RUN) marked <= 1'b0;
            beam <= next_beam;
            data <= take ? in_data[23:0] : 24'd0;
            if (top) first <= take && starts;
        end

        case (state)
            SYNC:
                if (head && starts) begin
                    state <= RUN;
                    next_beam <= 5'd0;
                    done <= 16'd0;
                    {some, whole} <= 2'b00;
                end
            RUN:
                if (take) begin
                    next_beam <= next_beam + 5'd1;
                    if (top && starts) begin
                        done <= 16'd0;
                        {some, whole} <= 2'b00;
                    end
                    if (bottom) begin
                        done <= done + 16'd1;
                        some <= 1'b1;
                        whole <= nearly;
                    end
                    if (last && !bottom) begin
                        state <= PAD;
                        resync <= 1'b1;
                    end else if (bottom && (!last || edge_after)) begin
                        state <= EDGE;
                        resync <= !last || ends;
                    end
                end else if (head && cut_column) begin
                    state <= PAD;
                    resync <= 1'b1;
                end else if (head && (cut_frame || beyond)) begin
                    state <= EDGE;
                    resync <= 1'b1;
                end
            PAD:
                if (go) begin
                    next_beam <= next_beam + 5'd1;
                    if (bottom) state <= EDGE;
                end
            default:
                if (go) begin
                    next_beam <= next_beam + 5'd1;
                    if (bottom) state <= resync ? SYNC : RUN;
                end
        endcase

        if (rst) begin
            state <= SYNC;
            resync <= 1'b0;
            next_beam <= 5'd0;
            done <= 16'd0;
            {some, whole} <= 2'b00;
            beat <= 1'b0;
        end
    end
`ifdef FORMAL
    reg past, slot1;
    reg [4:0] sent;  // beats that left, modulo 32
    wire leaves = slot1 && beat;
    wire [4:0] underway = sent + leaves;
    initial past = 0;
    always @(posedge clk) begin
        past <= 1'b1;
        assume (past || rst);
        slot1 <= slot && !rst;
        sent <= rst ? 5'd0 : underway;
        if (past && !rst && $past(!rst)) begin
            // Beams leave in order and columns are whole: between two columns nothing is lost or repeated.
            if (leaves) beams_in_order: assert (beam == sent);
            none_lost: assert (next_beam == underway);
            between_columns: assert (state != SYNC || next_beam == 5'd0);
            no_beat_without_room: assert (!$past(slot && !room) || !beat);
            no_ready_without_room: assert (!in_ready || (slot && room && in_valid));
            mark_is_a_columns: assert (!marked || state == PAD || state == SYNC || (state == RUN && !top));
            if (beat && !real_) edge_is_empty: assert (data == 24'd0 && !padded);
            // What is refused is told.
            if ($past(in_valid && in_ready) && !$past(take)) dropped_is_told: assert (ev_dropped);
            if ($past(take && in_data[24] && next_beam != 5'd31)) short_is_told: assert (ev_short_column);
            if ($past(take && !in_data[24] && next_beam == 5'd31)) long_is_told: assert (ev_long_column);
            if ($past(take && next_beam == 5'd31)) column_is_counted: assert (ev_column);
        end
    end
`endif
endmodule
