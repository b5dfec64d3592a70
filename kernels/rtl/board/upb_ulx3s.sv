// upb_ulx3s: upb_top on a ULX3S board (Lattice ECP5 LFE5U-12F, -25F or -85F, CABGA381). Pins: upb_ulx3s.lpf.
//
// Columns come and go as bytes on the two 40-pin headers, in step with clk_out, the board's 25 MHz clock (upb_bytes_in, upb_bytes_out: three
// bytes a beat in, six out: at most 3.5 million beats a second; 20 turns of 2048 columns a second need 1.3 million). Registers are on
// the USB serial port, 115200 baud (upb_uart). Power button: reset.
// LEDs: 0 interrupt, 1 changes with every column that comes in, 2 with every one that leaves, 3 reset.
// Built, not run on a board.
module upb_ulx3s #(
    parameter integer WRITABLE = 0,
    parameter integer DESTAGGER = 0,
    parameter integer DIVIDER = 217      // clocks a bit of the serial port
) (
    input  wire       clk_25mhz,
    input  wire       btn_pwr_n,
    input  wire       ftdi_txd,          // from the host
    output wire       ftdi_rxd,          // to the host
    output wire [3:0] led,

    output wire       clk_out,
    output wire       irq,
    input  wire [7:0] in_data,
    input  wire       in_valid,
    output wire       in_ready,
    input  wire       in_last,
    input  wire [1:0] in_user,
    output wire [7:0] out_data,
    output wire       out_valid,
    input  wire       out_ready,
    output wire       out_last,
    output wire [1:0] out_user
);
    wire clk = clk_25mhz;
    assign clk_out = clk;

    reg [1:0] button = 2'b00;
    reg [7:0] power_on = 8'd0;
    reg resetn = 1'b0;
    always @(posedge clk) begin
        button <= {button[0], btn_pwr_n};
        if (!button[1]) power_on <= 8'd0;
        else if (!(&power_on)) power_on <= power_on + 8'd1;
        resetn <= &power_on;
    end

    wire [14:0] address;
    wire [31:0] wdata, rdata;
    wire [1:0] bresp, rresp;
    wire awvalid, awready, wvalid, wready, bvalid, arvalid, arready, rvalid;
    upb_uart #(.DIVIDER(DIVIDER)) uart (
        .clk(clk), .rst(!resetn), .rx(ftdi_txd), .tx(ftdi_rxd),
        .address(address), .awvalid(awvalid), .awready(awready), .wdata(wdata), .wvalid(wvalid), .wready(wready),
        .bresp(bresp), .bvalid(bvalid), .arvalid(arvalid), .arready(arready), .rdata(rdata), .rresp(rresp), .rvalid(rvalid)
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
    wire beat_valid, beat_ready, beat_last;
    wire [1:0] beat_user;
    upb_top #(.WRITABLE(WRITABLE), .DESTAGGER(DESTAGGER), .CLOCK_HZ(32'd25000000)) top (
        .aclk(clk), .aresetn(resetn),
        .s_axis_tdata(word), .s_axis_tvalid(word_valid), .s_axis_tready(word_ready), .s_axis_tlast(word_last),
        .s_axis_tuser(word_user),
        .m_axis_tdata(beat), .m_axis_tvalid(beat_valid), .m_axis_tready(beat_ready), .m_axis_tlast(beat_last),
        .m_axis_tuser(beat_user),
        .s_axil_awaddr(address), .s_axil_awprot(3'd0), .s_axil_awvalid(awvalid), .s_axil_awready(awready),
        .s_axil_wdata(wdata), .s_axil_wstrb(4'b1111), .s_axil_wvalid(wvalid), .s_axil_wready(wready),
        .s_axil_bresp(bresp), .s_axil_bvalid(bvalid), .s_axil_bready(1'b1),
        .s_axil_araddr(address), .s_axil_arprot(3'd0), .s_axil_arvalid(arvalid), .s_axil_arready(arready),
        .s_axil_rdata(rdata), .s_axil_rresp(rresp), .s_axil_rvalid(rvalid), .s_axil_rready(1'b1),
        .irq(irq)
    );

    upb_bytes_out to_bytes (
        .clk(clk), .resetn(resetn),
        .beat(beat), .beat_valid(beat_valid), .beat_ready(beat_ready), .beat_last(beat_last), .beat_user(beat_user),
        .out_data(out_data), .out_valid(out_valid), .out_ready(out_ready), .out_last(out_last), .out_user(out_user)
    );

    reg column_in, column_out;
    always @(posedge clk)
        if (!resetn) {column_out, column_in} <= 2'b00;
        else begin
            if (word_valid && word_ready && word_last) column_in <= !column_in;
            if (beat_valid && beat_ready && beat_last) column_out <= !column_out;
        end
    assign led = {!resetn, column_out, column_in, irq};
endmodule
