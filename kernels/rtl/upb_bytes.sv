// upb_bytes: upb_core behind two byte streams, for parts and boards with few pins.
//
// In:  three bytes a beat, distance low byte first, then intensity; in_last and in_user with the third.
// Out: six bytes a beat: sensor distance low, high, intensity; generated distance low, high, intensity.
//      out_last with the sixth byte of beat 31; out_user[0] with all bytes of the first beat of a frame, out_user[1] as in upb_core.
// Both ready outputs depend on registers alone. Rate: a beat every 6 clocks or every FOLD / LANES clocks, whichever is more.
module upb_bytes (
    input  wire       clk,
    input  wire       resetn,
    input  wire [7:0] in_data,
    input  wire       in_valid,
    output wire       in_ready,
    input  wire       in_last,
    input  wire [1:0] in_user,
    output wire [7:0] out_data,
    output wire       out_valid,
    input  wire       out_ready,
    output wire       out_last,
    output wire [1:0] out_user,
    output reg        error          // since reset: something did not fit, or was lost
);
    wire [23:0] word;
    wire word_valid, word_ready, word_last;
    wire [1:0] word_user;
    upb_bytes_in to_beats (
        .clk(clk), .resetn(resetn),
        .in_data(in_data), .in_valid(in_valid), .in_ready(in_ready), .in_last(in_last), .in_user(in_user),
        .beat(word), .beat_valid(word_valid), .beat_ready(word_ready), .beat_last(word_last), .beat_user(word_user)
    );

    wire [47:0] beat;
    wire beat_valid, beat_taken, beat_last;
    wire [1:0] beat_user;
    wire [7:0] events;
    upb_core core (
        .aclk(clk), .aresetn(resetn), .cfg_columns(upb_pkg::UPB_COLUMNS[15:0]),
        .s_axis_tdata(word), .s_axis_tvalid(word_valid), .s_axis_tready(word_ready),
        .s_axis_tlast(word_last), .s_axis_tuser(word_user),
        .m_axis_tdata(beat), .m_axis_tvalid(beat_valid), .m_axis_tready(beat_taken),
        .m_axis_tlast(beat_last), .m_axis_tuser(beat_user),
        .ev_column(events[0]), .ev_frame(events[1]), .ev_short_column(events[2]), .ev_long_column(events[3]),
        .ev_short_frame(events[4]), .ev_long_frame(events[5]), .ev_dropped(events[6]), .ev_overrun(events[7]),
        .weights(45'd0), .weights_bank(1'b0), .weights_swap(1'b0), .ev_swapped()
    );
    always @(posedge clk)
        if (!resetn) error <= 1'b0;
        else if (|events[7:2]) error <= 1'b1;

    upb_bytes_out to_bytes (
        .clk(clk), .resetn(resetn),
        .beat(beat), .beat_valid(beat_valid), .beat_ready(beat_taken), .beat_last(beat_last), .beat_user(beat_user),
        .out_data(out_data), .out_valid(out_valid), .out_ready(out_ready), .out_last(out_last), .out_user(out_user)
    );
endmodule
