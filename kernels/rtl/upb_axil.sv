// upb_axil: AXI4-Lite subordinate, to a plain register bus. One write and one read at a time, side by side.
//
// `write` and `read` last one clock; address, data and strobe are valid with them; the answer (`write_error`; `read_data`,
// `read_error`) is given in the same clock. An error is answered SLVERR. Ready signals are registered: no path leads from a
// valid or a ready of the bus to a ready.
// Latency: write: two clocks from the later of AW and W to B; read: two clocks from AR to R. A write every two clocks.
module upb_axil #(
    parameter integer ADDRESS = 15
) (
    input  wire               clk,
    input  wire               rst,

    input  wire [ADDRESS-1:0] s_axil_awaddr,
    input  wire               s_axil_awvalid,
    output wire               s_axil_awready,
    input  wire [       31:0] s_axil_wdata,
    input  wire [        3:0] s_axil_wstrb,
    input  wire               s_axil_wvalid,
    output wire               s_axil_wready,
    output reg  [        1:0] s_axil_bresp,
    output reg                s_axil_bvalid,
    input  wire               s_axil_bready,
    input  wire [ADDRESS-1:0] s_axil_araddr,
    input  wire               s_axil_arvalid,
    output wire               s_axil_arready,
    output reg  [       31:0] s_axil_rdata,
    output reg  [        1:0] s_axil_rresp,
    output reg                s_axil_rvalid,
    input  wire               s_axil_rready,

    output wire               write,
    output reg  [ADDRESS-1:0] write_address,
    output reg  [       31:0] write_data,
    output reg  [        3:0] write_strobe,
    input  wire               write_error,
    output wire               read,
    output reg  [ADDRESS-1:0] read_address,
    input  wire [       31:0] read_data,
    input  wire               read_error
);
    localparam [1:0] OKAY = 2'b00, SLVERR = 2'b10;

    reg awake, has_address, has_data, has_read;
    assign s_axil_awready = awake && !has_address;
    assign s_axil_wready = awake && !has_data;
    assign s_axil_arready = awake && !has_read;
    assign write = has_address && has_data && !s_axil_bvalid;
    assign read = has_read && !s_axil_rvalid;

    always @(posedge clk) begin
        if (s_axil_awready) write_address <= s_axil_awaddr;
        if (s_axil_wready) {write_strobe, write_data} <= {s_axil_wstrb, s_axil_wdata};
        if (s_axil_arready) read_address <= s_axil_araddr;
        if (write) s_axil_bresp <= write_error ? SLVERR : OKAY;
        if (read) begin
            s_axil_rresp <= read_error ? SLVERR : OKAY;
            s_axil_rdata <= read_error ? 32'd0 : read_data;
        end
        if (rst) begin
            awake <= 1'b0;
            has_address <= 1'b0;
            has_data <= 1'b0;
            has_read <= 1'b0;
            s_axil_bvalid <= 1'b0;
            s_axil_rvalid <= 1'b0;
        end else begin
            awake <= 1'b1;
            if (write) {has_address, has_data} <= 2'b00;
            if (s_axil_awvalid && s_axil_awready) has_address <= 1'b1;
            if (s_axil_wvalid && s_axil_wready) has_data <= 1'b1;
            s_axil_bvalid <= write || (s_axil_bvalid && !s_axil_bready);
            if (read) has_read <= 1'b0;
            if (s_axil_arvalid && s_axil_arready) has_read <= 1'b1;
            s_axil_rvalid <= read || (s_axil_rvalid && !s_axil_rready);
        end
    end

`ifdef FORMAL
    // What was accepted and not yet answered; three bits hold more than there can be.
    reg [2:0] addresses, datas, reads;
    reg past;
    initial {past, addresses, datas, reads} = 0;
    wire answered = s_axil_bvalid && s_axil_bready;
    wire given = s_axil_rvalid && s_axil_rready;
    always @(posedge clk) begin
        past <= 1'b1;
        if (rst) {addresses, datas, reads} <= 0;
        else begin
            addresses <= addresses + (s_axil_awvalid && s_axil_awready) - answered;
            datas <= datas + (s_axil_wvalid && s_axil_wready) - answered;
            reads <= reads + (s_axil_arvalid && s_axil_arready) - given;
        end
        assume (past || rst);
        if (past && !rst) begin
            if ($past(s_axil_bvalid && !s_axil_bready && !rst)) begin
                b_holds: assert (s_axil_bvalid);
                b_stable: assert ($stable(s_axil_bresp));
            end
            if ($past(s_axil_rvalid && !s_axil_rready && !rst)) begin
                r_holds: assert (s_axil_rvalid);
                r_stable: assert ($stable({s_axil_rresp, s_axil_rdata}));
            end
            b_after_address: assert (addresses == {2'd0, has_address} + {2'd0, s_axil_bvalid});
            b_after_data: assert (datas == {2'd0, has_data} + {2'd0, s_axil_bvalid});
            r_after_address: assert (reads == {2'd0, has_read} + {2'd0, s_axil_rvalid});
            if ($past(write && !rst)) b_follows: assert (s_axil_bvalid && s_axil_bresp == ($past(write_error) ? SLVERR : OKAY));
            if ($past(read && !rst)) r_follows: assert (s_axil_rvalid && s_axil_rresp == ($past(read_error) ? SLVERR : OKAY));
            one_write: assert (!(write && $past(write)));
            ready_again: assert (!$past(!rst && !has_address && awake) || s_axil_awready || has_address);
        end
        if (past && $past(rst)) reset_quiet: assert (!s_axil_bvalid && !s_axil_rvalid && !s_axil_awready && !s_axil_arready);
    end
`endif
endmodule
