// upb_columns: the column store: a beat in, the pair of beams (above, this one) of three neighbouring columns out.
//
//   window of beams (b - 1, b), columns (c - 1, c, c + 1), at the beat of beam b of column c + 1;
//   a pixel is seen where MIN_COUNT <= count <= SEEN_MAX[b] and its column is no edge; what is not seen is 0.
//
// Two small memories of 32 pixels hold columns c and c - 1; no frame buffer. The sensor's own pixel leaves as it came (`own`).
// Beat 31 of an output column has no window: it follows in the slot after beam 31 (`tail`), with or without a new beat.
// Latency: strobe and beat at clock t -> window at t + 2 (LATENCY), there until the next strobe's.
module upb_columns #(
    parameter [15:0] MIN_COUNT = 16'd1,
    parameter [32*16-1:0] SEEN_MAX = {512{1'b1}}
) (
    input  wire         clk,
    input  wire         rst,
    input  wire         strobe,
    input  wire         beat,
    input  wire         real_,
    input  wire         padded,
    input  wire         first,
    input  wire [  4:0] beam,
    input  wire [ 23:0] data,
    output reg  [  5:0] seen,        // [r0c-1, r0c0, r0c+1, r1c-1, r1c0, r1c+1], bit 0 first
    output reg  [ 95:0] distance,    // 6 x 16, the same order
    output reg  [ 47:0] intensity,   // 6 x 8
    output reg  [ 23:0] own,         // {intensity, distance} of beam `row`, column c, as received
    output reg  [  4:0] row,         // of this output beat: the upper beam of the window
    output reg          valid,       // an output beat comes of this slot
    output reg          starts,      // it is the first of a frame
    output reg          tail,        // it is the last of a column
    output reg          incomplete   // its column was padded
);
    // ------------------------------------------------------------------ stage 1: memories and the row's limit
    reg  [24:0] middle[0:31];
    reg  [24:0] left  [0:31];
    reg  [24:0] middle_read;
    reg  [24:0] left_read;
    wire [15:0] limit;
    reg         strobe1, beat1, real1, padded1, first1;
    reg  [ 4:0] beam1;
    reg  [23:0] data1;

    upb_rom #(.WIDTH(16), .DEPTH(32), .ADDRESS(5), .INIT(SEEN_MAX)) limits (
        .clk(clk), .address(beam), .q(limit)
    );

    wire        seen_now = data1[15:0] >= MIN_COUNT && data1[15:0] <= limit;
    wire [24:0] pixel = {seen_now, data1};
    wire        enters = strobe1 && beat1;

    always @(posedge clk) begin
        strobe1 <= strobe && !rst;
        beat1 <= beat;
        real1 <= real_;
        padded1 <= padded;
        first1 <= first;
        beam1 <= beam;
        data1 <= data;
        if (strobe) begin
            middle_read <= middle[beam];
            left_read <= left[beam];
        end
        if (enters) begin
            middle[beam1] <= pixel;
            left[beam1] <= middle_read;
        end
    end

    // ------------------------------------------------------------------ stage 2: the window
    // Columns by age: right is the one that arrives. Their properties move on with the first beam of a column.
    reg real_right, real_middle, real_left, first_right, first_middle, padded_right, padded_middle;
    reg has_tail;  // beam 31 has just gone by, of a column that is no edge

    wire move = beat1 && beam1 == 5'd0;
    wire left_is = move ? real_middle : real_left;
    wire middle_is = move ? real_right : real_middle;
    wire right_is = move ? real1 : real_right;

    function automatic [24:0] shown(input [24:0] value, input is);
        shown = (is && value[24]) ? value : 25'd0;
    endfunction

    wire [24:0] left_pixel = shown(left_read, left_is);
    wire [24:0] middle_pixel = shown(middle_read, middle_is);
    wire [24:0] right_pixel = shown(pixel, right_is);
    reg  [23:0] own_next;

    always @(posedge clk) begin
        if (strobe1 && (beat1 || has_tail)) begin
            seen[2:0] <= seen[5:3];
            distance[47:0] <= distance[95:48];
            intensity[23:0] <= intensity[47:24];
            own <= own_next;
        end
        if (enters) begin
            seen[5:3] <= {right_pixel[24], middle_pixel[24], left_pixel[24]};
            distance[95:48] <= {right_pixel[15:0], middle_pixel[15:0], left_pixel[15:0]};
            intensity[47:24] <= {right_pixel[23:16], middle_pixel[23:16], left_pixel[23:16]};
            own_next <= middle_read[23:0];
            if (move) begin
                {real_left, real_middle, real_right} <= {real_middle, real_right, real1};
                {first_middle, first_right} <= {first_right, first1};
                padded_middle <= padded_right;
            end
            padded_right <= padded1;
        end
        if (strobe1) begin
            has_tail <= beat1 && beam1 == 5'd31 && real_middle;
            valid <= (beat1 && !move && real_middle) || has_tail;
            row <= has_tail ? 5'd31 : beam1 - 5'd1;
            tail <= has_tail;
            starts <= beam1 == 5'd1 && first_middle && !has_tail;
            incomplete <= padded_middle;
        end
        if (rst) begin
            has_tail <= 1'b0;
            valid <= 1'b0;
            {real_left, real_middle, real_right} <= 3'b000;
        end
    end
endmodule
