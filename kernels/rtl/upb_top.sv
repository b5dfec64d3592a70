`include "upb_check.svh"
// upb_top: both networks behind two AXI4-Streams and a register block on AXI4-Lite; with DESTAGGER a ring in front, for sensors whose
// lasers do not share an azimuth.
//
//   s_axis -> (upb_destagger) -> upb_core -> m_axis;  s_axil -> upb_registers -> irq, weights
//
// Streams: as upb_core and upb_destagger say. Registers: docs/fpga-registers.md. After reset the core waits for CONTROL.ENABLE.
// One clock. aresetn: synchronous, active low, at least one clock; the core's own longer reset is made of it.
// Latency: that of the core, with DESTAGGER 3 clocks and UPB_RING_DELAY columns more.
//
// LANES, FOLD: must be those of the generated upb_config.svh. WRITABLE: weights can be written (FOLD > 1).
// CLOCK_HZ: what CLOCK_HZ reads, for software that counts time.
module upb_top #(
    parameter integer LANES = upb_pkg::UPB_LANES,
    parameter integer FOLD = upb_pkg::UPB_FOLD,
    parameter integer WRITABLE = 0,
    parameter integer DESTAGGER = 0,
    parameter [31:0] CLOCK_HZ = 32'd0
) (
    input  wire        aclk,
    input  wire        aresetn,

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

    input  wire [14:0] s_axil_awaddr,
    input  wire [ 2:0] s_axil_awprot,    // not looked at
    input  wire        s_axil_awvalid,
    output wire        s_axil_awready,
    input  wire [31:0] s_axil_wdata,
    input  wire [ 3:0] s_axil_wstrb,
    input  wire        s_axil_wvalid,
    output wire        s_axil_wready,
    output wire [ 1:0] s_axil_bresp,
    output wire        s_axil_bvalid,
    input  wire        s_axil_bready,
    input  wire [14:0] s_axil_araddr,
    input  wire [ 2:0] s_axil_arprot,    // not looked at
    input  wire        s_axil_arvalid,
    output wire        s_axil_arready,
    output wire [31:0] s_axil_rdata,
    output wire [ 1:0] s_axil_rresp,
    output wire        s_axil_rvalid,
    input  wire        s_axil_rready,

    output wire        irq                // level, high
);
    `include "upb_beams.svh"

    `UPB_REQUIRE(WRITABLE == 0 || WRITABLE == 1, bad_writable, "upb_top: WRITABLE must be 0 or 1")
    `UPB_REQUIRE(DESTAGGER == 0 || DESTAGGER == 1, bad_destagger, "upb_top: DESTAGGER must be 0 or 1")
    `UPB_REQUIRE(DESTAGGER == 0 || UPB_RING_SLOTS > 1, no_ring,
                 "upb_top: DESTAGGER is 1, but all lasers of this model's beam table share their azimuth")
    `UPB_REQUIRE(UPB_BEAMS_CRC32 == upb_pkg::UPB_MODEL_CRC32, other_model,
                 "upb_top: upb_beams.svh and upb_params.svh are of different models")

    wire clk = aclk;
    reg rst;
    always @(posedge clk) rst <= !aresetn;

    // ------------------------------------------------------------------ registers
    function automatic [31:0] scale(input integer k, input integer j, input integer t, input integer skip);
        scale = {7'd0, skip != 0, t[7:0], j[7:0], k[7:0]};
    endfunction
    localparam [31:0] SHAPE = (FOLD & 4095) | (LANES & 1023) << 12 | (upb_pkg::UPB_HIDDEN & 63) << 22 |
        (upb_pkg::UPB_WEIGHT_BITS == 16 ? 1 : 0) << 28 | WRITABLE << 29 | DESTAGGER << 30;
    localparam [31:0] RING = DESTAGGER != 0 ? UPB_RING_DELAY << 16 | UPB_RING_SLOTS : 0;

    wire running, bank, swap, ev_swapped;
    wire [15:0] columns;
    wire [44:0] weights;
    wire ev_column, ev_frame, ev_short_column, ev_long_column, ev_short_frame, ev_long_frame, ev_dropped, ev_overrun;
    upb_registers #(
        .CONTRACT(upb_pkg::UPB_CONTRACT), .MODEL_CRC(upb_pkg::UPB_MODEL_CRC32), .SHAPE(SHAPE),
        .SCALE_DISTANCE(scale(
            upb_pkg::UPB_DISTANCE_K, upb_pkg::UPB_DISTANCE_J, upb_pkg::UPB_DISTANCE_T, upb_pkg::UPB_DISTANCE_SKIP)),
        .SCALE_INTENSITY(scale(
            upb_pkg::UPB_INTENSITY_K, upb_pkg::UPB_INTENSITY_J, upb_pkg::UPB_INTENSITY_T, upb_pkg::UPB_INTENSITY_SKIP)),
        .SLOPES(upb_pkg::UPB_INTENSITY_SLOPE << 16 | upb_pkg::UPB_DISTANCE_SLOPE), .RING(RING),
        .CLOCK_HZ(CLOCK_HZ), .COLUMNS(upb_pkg::UPB_COLUMNS), .WRITABLE(WRITABLE)
    ) registers (
        .clk(clk), .rst(rst),
        .s_axil_awaddr(s_axil_awaddr), .s_axil_awvalid(s_axil_awvalid), .s_axil_awready(s_axil_awready),
        .s_axil_wdata(s_axil_wdata), .s_axil_wstrb(s_axil_wstrb), .s_axil_wvalid(s_axil_wvalid),
        .s_axil_wready(s_axil_wready), .s_axil_bresp(s_axil_bresp), .s_axil_bvalid(s_axil_bvalid),
        .s_axil_bready(s_axil_bready), .s_axil_araddr(s_axil_araddr), .s_axil_arvalid(s_axil_arvalid),
        .s_axil_arready(s_axil_arready), .s_axil_rdata(s_axil_rdata), .s_axil_rresp(s_axil_rresp),
        .s_axil_rvalid(s_axil_rvalid), .s_axil_rready(s_axil_rready), .irq(irq),
        .running(running), .columns(columns),
        .ev_column(ev_column), .ev_frame(ev_frame), .ev_short_column(ev_short_column), .ev_long_column(ev_long_column),
        .ev_short_frame(ev_short_frame), .ev_long_frame(ev_long_frame), .ev_dropped(ev_dropped), .ev_overrun(ev_overrun),
        .out_beat(m_axis_tvalid && m_axis_tready), .out_last(m_axis_tlast), .out_starts(m_axis_tuser[0]),
        .out_waits(m_axis_tvalid && !m_axis_tready),
        .weights(weights), .bank(bank), .swap(swap), .ev_swapped(ev_swapped)
    );

    // ------------------------------------------------------------------ streams
    wire [23:0] core_tdata;
    wire [1:0] core_tuser;
    wire core_tvalid, core_tready, core_tlast;
    wire core_short_column, core_long_column, core_short_frame, core_long_frame, core_dropped;
    generate
        if (DESTAGGER == 0) begin : aligned
            assign {core_tdata, core_tvalid, core_tlast, core_tuser} = {s_axis_tdata, s_axis_tvalid, s_axis_tlast, s_axis_tuser};
            assign s_axis_tready = core_tready;
            assign {ev_short_column, ev_long_column, ev_short_frame, ev_long_frame, ev_dropped} =
                {core_short_column, core_long_column, core_short_frame, core_long_frame, core_dropped};
        end else begin : firing
            // The core behind sees whole frames only, whatever comes in: errors of framing are the ring's to tell.
            reg rst_ring;
            always @(posedge clk) rst_ring <= !running;
            upb_destagger #(.SLOTS(UPB_RING_SLOTS), .DELAY(UPB_RING_DELAY), .LAG(UPB_RING_LAG)) ring (
                .clk(clk), .rst(rst_ring), .columns(columns),
                .s_axis_tdata(s_axis_tdata), .s_axis_tvalid(s_axis_tvalid), .s_axis_tready(s_axis_tready),
                .s_axis_tlast(s_axis_tlast), .s_axis_tuser(s_axis_tuser),
                .m_axis_tdata(core_tdata), .m_axis_tvalid(core_tvalid), .m_axis_tready(core_tready),
                .m_axis_tlast(core_tlast), .m_axis_tuser(core_tuser),
                .ev_short_column(ev_short_column), .ev_long_column(ev_long_column),
                .ev_short_frame(ev_short_frame), .ev_long_frame(ev_long_frame), .ev_dropped(ev_dropped)
            );
        end
    endgenerate

    upb_core #(.LANES(LANES), .FOLD(FOLD), .WRITABLE(WRITABLE)) core (
        .aclk(clk), .aresetn(running), .cfg_columns(columns),
        .s_axis_tdata(core_tdata), .s_axis_tvalid(core_tvalid), .s_axis_tready(core_tready),
        .s_axis_tlast(core_tlast), .s_axis_tuser(core_tuser),
        .m_axis_tdata(m_axis_tdata), .m_axis_tvalid(m_axis_tvalid), .m_axis_tready(m_axis_tready),
        .m_axis_tlast(m_axis_tlast), .m_axis_tuser(m_axis_tuser),
        .ev_column(ev_column), .ev_frame(ev_frame), .ev_short_column(core_short_column), .ev_long_column(core_long_column),
        .ev_short_frame(core_short_frame), .ev_long_frame(core_long_frame), .ev_dropped(core_dropped),
        .ev_overrun(ev_overrun),
        .weights(weights), .weights_bank(bank), .weights_swap(swap), .ev_swapped(ev_swapped)
    );
endmodule
