// upb_bytes_in: three bytes to a beat: distance low, high, intensity; in_last and in_user are those of the third.
// in_ready depends on registers alone. Rate: a beat every 4 clocks. Latency: 1 clock from the third byte to the beat.
module upb_bytes_in (
    input  wire        clk,
    input  wire        resetn,
    input  wire [ 7:0] in_data,
    input  wire        in_valid,
    output wire        in_ready,
    input  wire        in_last,
    input  wire [ 1:0] in_user,
    output reg  [23:0] beat,
    output wire        beat_valid,
    input  wire        beat_ready,
    output reg         beat_last,
    output reg  [ 1:0] beat_user
);
    reg [1:0] have;  // bytes at hand; 3: a beat is offered
    reg awake;
    assign in_ready = awake && have != 2'd3;
    assign beat_valid = have == 2'd3;
    always @(posedge clk) begin
        awake <= resetn;
        if (!resetn) have <= 2'd0;
        else if (have == 2'd3) begin
            if (beat_ready) have <= 2'd0;
        end else if (in_valid && in_ready) begin
            have <= have + 2'd1;
            beat <= {in_data, beat[23:8]};
            beat_last <= in_last;
            beat_user <= in_user;
        end
    end
endmodule
