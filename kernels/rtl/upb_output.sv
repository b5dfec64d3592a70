// upb_output: steps 8 and 9 of the contract, the limits of what is given, and the pair of rows of an output beat.
//
//   y = (total >> T) + SKIP * m                (half a step is in the total already)
//   distance  = y where MIN_COUNT <= y <= GIVEN_MAX[row] and (rule `fill`) m > 0, else 0
//   intensity = min(255, max(0, y)) where the distance is not 0, else 0
//   beam 31 has no generated row below: row 63 repeats it or is empty
//
// Latency: 3 clocks from the distance's total, own pixel and m; the intensity's total and m come EARLY clocks before them.
module upb_output #(
    parameter integer EARLY = 0,
    parameter [15:0] MIN_COUNT = 16'd1,
    parameter [31*16-1:0] GIVEN_MAX = {496{1'b1}},
    parameter integer EMPTY_FILL = 1,
    parameter integer LAST_ROW_EMPTY = 1,
    parameter integer DISTANCE_T = 0, DISTANCE_SKIP = 1,
    parameter integer INTENSITY_T = 0, INTENSITY_SKIP = 1
) (
    input  wire        clk,
    input  wire [31:0] distance_total,
    input  wire [15:0] distance_m,
    input  wire [31:0] intensity_total,
    input  wire [ 7:0] intensity_m,
    input  wire [ 4:0] row,
    input  wire        tail,
    input  wire [23:0] own,
    output reg  [47:0] beat              // {generated, own}, each {intensity, distance}
);
    // ------------------------------------------------------------------ intensity: two clocks, then it waits
    wire signed [31:0] grey_r = $signed(intensity_total) >>> INTENSITY_T;
    wire signed [31:0] grey_skip = INTENSITY_SKIP != 0 ? {24'd0, intensity_m} : 32'd0;
    reg  signed [31:0] grey_y;
    reg  [7:0] grey;
    wire [7:0] grey_late;
    always @(posedge clk) begin
        grey_y <= grey_r + grey_skip;
        grey <= grey_y[31] ? 8'd0 : |grey_y[30:8] ? 8'd255 : grey_y[7:0];
    end
    upb_shift #(.WIDTH(8), .DEPTH(EARLY)) wait_ (.clk(clk), .d(grey), .q(grey_late));

    // ------------------------------------------------------------------ distance
    wire signed [31:0] far_r = $signed(distance_total) >>> DISTANCE_T;
    wire signed [31:0] far_skip = DISTANCE_SKIP != 0 ? {16'd0, distance_m} : 32'd0;
    wire [15:0] limit;
    upb_rom #(.WIDTH(16), .DEPTH(32), .ADDRESS(5), .INIT({16'd0, GIVEN_MAX})) limits (
        .clk(clk), .address(row), .q(limit)
    );
    reg signed [31:0] far_y;
    reg [15:0] far;
    reg any, given, tail1, tail2;
    reg [23:0] own1, own2;
    always @(posedge clk) begin
        far_y <= far_r + far_skip;
        any <= EMPTY_FILL == 0 || distance_m != 16'd0;
        far <= far_y[15:0];
        given <= any && far_y[31:16] == 16'd0 && far_y[15:0] >= MIN_COUNT && far_y[15:0] <= limit;
        {tail2, tail1} <= {tail1, tail};
        {own2, own1} <= {own1, own};
        beat[23:0] <= own2;
        if (tail2) beat[47:24] <= LAST_ROW_EMPTY != 0 ? 24'd0 : own2;
        else beat[47:24] <= given ? {grey_late, far} : 24'd0;
    end
endmodule
