// upb_bytes_out: a beat to six bytes: sensor distance low, high, intensity; generated distance low, high, intensity. out_last is with
// the sixth byte of a beat that has beat_last; out_user with all bytes of its beat.
// beat_ready depends on registers alone. Rate: a beat every 7 clocks. Latency: 1 clock from the beat to the first byte.
module upb_bytes_out (
    input  wire        clk,
    input  wire        resetn,
    input  wire [47:0] beat,
    input  wire        beat_valid,
    output wire        beat_ready,
    input  wire        beat_last,
    input  wire [ 1:0] beat_user,
    output wire [ 7:0] out_data,
    output wire        out_valid,
    input  wire        out_ready,
    output wire        out_last,
    output wire [ 1:0] out_user
);
    reg [ 2:0] left;  // bytes still to give
    reg [47:0] rest;
    reg        rest_last;
    reg [ 1:0] rest_user;
    assign beat_ready = left == 3'd0;
    assign out_data = rest[7:0];
    assign out_valid = left != 3'd0;
    assign out_last = rest_last && left == 3'd1;
    assign out_user = rest_user;
    always @(posedge clk)
        if (!resetn) left <= 3'd0;
        else if (left == 3'd0) begin
            if (beat_valid) left <= 3'd6;
            rest <= beat;
            rest_last <= beat_last;
            rest_user <= beat_user;
        end else if (out_ready) begin
            left <= left - 3'd1;
            rest <= {8'd0, rest[47:8]};
        end
endmodule
